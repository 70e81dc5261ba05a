"""Compile the C++ peers with what this machine has: a compiler, Eigen and Crocoddyl.

Crocoddyl is looked for under a prefix (with include/ and lib/): an argument, the environment
variable CROCODDYL_PREFIX, or cmeel.prefix in the running Python's site-packages, where
`pip install crocoddyl cmeel-eigen` puts it and its headers.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path

HERE = Path(__file__).resolve().parent
LABELS = {"floor_peer": "floor (C++)", "crocoddyl_peer": "Crocoddyl (compiled, C++ models)"}
PEERS = tuple(LABELS)
# Any warning here is one of Eigen's or GCC's own headers, and there are thousands of lines of them.
FLAGS = ("-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-w")
# With these the cost from each problem's own start ends within 1e-6, relatively, of the cost with a
# far smaller threshold, and hardly an iteration sooner. The floor's are relative to the cost.
TH_STOP = {
    "floor_peer": {"P1": 2.2e-7, "P2": 2e-4, "P3f": 5e-7, "P4-4": 5e-6, "P4-8": 5e-7},
    "crocoddyl_peer": {
        "P1": 2.5e-11, "P2": 1e-7, "P3f": 8e-13, "P3": 1.2e-12, "P3h": 7.5e-11, "P4-4": 2e-10,
        "P4-8": 1.2e-12,
    },
}  # fmt: skip


class Missing(Exception):
    """Something that a peer needs is not here."""


def find_compiler() -> str:
    """Return a C++ compiler's path: $CXX, g++, clang++ or c++."""
    for name in (os.environ.get("CXX"), "g++", "clang++", "c++"):
        if name and (path := shutil.which(name)):
            return path
    raise Missing("no C++ compiler (such as g++)")


def find_eigen(prefixes: Iterable[Path]) -> Path:
    """Return the folder to include for Eigen."""
    packages = Path(sysconfig.get_path("purelib"))
    for prefix in (*prefixes, packages / "cmeel.prefix", packages / "casadi", "/usr", "/usr/local"):
        for folder in (Path(prefix, "include", "eigen3"), Path(prefix, "include")):
            if (folder / "Eigen" / "Core").is_file():
                return folder
    raise Missing("no Eigen headers (pip install cmeel-eigen)")


def find_crocoddyl(prefix: str | os.PathLike | None) -> Path:
    """Return Crocoddyl's prefix."""
    default = Path(sysconfig.get_path("purelib")) / "cmeel.prefix"
    root = Path(prefix or os.environ.get("CROCODDYL_PREFIX") or default).resolve()
    config = root / "include" / "crocoddyl" / "config.hpp"
    if not config.is_file() or not any((root / "lib").glob("libcrocoddyl.*")):
        raise Missing("no Crocoddyl headers and library (pip install crocoddyl cmeel-eigen)")
    version = re.search(r'CROCODDYL_VERSION "([^"]*)"', config.read_text())
    if version is None or not version[1].startswith("3."):
        raise Missing(f"Crocoddyl {version[1] if version else 'of unknown version'}, not 3.x")
    return root


def command(name: str, prefix: str | os.PathLike | None) -> list[str]:
    """Return the command that compiles one program, but for its output."""
    start = [find_compiler(), *FLAGS, str(HERE / f"{name}.cpp")]
    if name != "crocoddyl_peer":
        prefixes = [Path(p) for p in (prefix, os.environ.get("CROCODDYL_PREFIX")) if p]
        return [*start, "-isystem", str(find_eigen(prefixes))]
    root = find_crocoddyl(prefix)
    # The library was compiled without -march=native: Eigen must allocate as it does there, and
    # its code for this machine must not replace the library's when both are loaded.
    start += ["-DEIGEN_MAX_ALIGN_BYTES=16", "-DEIGEN_MALLOC_ALREADY_ALIGNED=1"]
    start += ["-fvisibility=hidden"]
    start += ["-isystem", str(find_eigen([root])), "-isystem", str(root / "include")]
    start += [f"-L{root / 'lib'}", "-lcrocoddyl", f"-Wl,-rpath,{root / 'lib'}"]
    # The library finds its own dependencies through our rpath only if it is of the older kind.
    return [*start, "-Wl,--disable-new-dtags"] if sys.platform == "linux" else start


def build(
    folder: str | os.PathLike,
    prefix: str | os.PathLike | None = None,
    names: Iterable[str] = PEERS,
) -> tuple[dict[str, Path], dict[str, str]]:
    """Compile into `folder`; return each program's path, and a reason for each one left out.

    A program is compiled again only if its sources or its command have changed.
    """
    folder = Path(folder).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    built, reasons = {}, {}
    for name in names:
        program, stamp = folder / name, folder / f"{name}.stamp"
        try:
            line = command(name, prefix)
            sources = [HERE / f"{name}.cpp", *sorted(HERE.glob("*.hpp"))]
            known = "\n".join([*line, *(path.read_text() for path in sources)])
            digest = hashlib.sha256(known.encode()).hexdigest()
            if not (program.exists() and stamp.exists() and stamp.read_text() == digest):
                run = subprocess.run([*line, "-o", program], capture_output=True, text=True)
                if run.returncode != 0:
                    errors = [text for text in run.stderr.splitlines() if "error" in text]
                    raise Missing(f"it does not compile: {(errors or ['no message'])[0][:300]}")
                stamp.write_text(digest)
            built[name] = program
        except Missing as reason:
            reasons[name] = str(reason)
    return built, reasons
