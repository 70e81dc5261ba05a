"""What is installed: the package with its types, and no program of others."""

import zipfile
from pathlib import Path

import pytest

wheel = pytest.importorskip("hatchling.builders.wheel")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    (file,) = wheel.WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    return set(zipfile.ZipFile(file).namelist())


def test_the_wheel_holds_every_module_and_what_they_read(names):
    package = {p for p in (ROOT / "jaxctrl").rglob("*") if "__pycache__" not in p.parts}
    wanted = {str(path.relative_to(ROOT)) for path in package if path.is_file()}
    assert wanted == {name for name in names if name.startswith("jaxctrl/")}
    assert {"jaxctrl/__init__.pyi", "jaxctrl/py.typed"} <= names


def test_the_wheel_holds_nothing_of_the_repository_besides(names):
    assert {name.split("/")[0].split("-")[0] for name in names} == {"jaxctrl"}
    kinds = {Path(name).suffix for name in names if name.startswith("jaxctrl/")}
    assert kinds == {".py", ".pyi", ".typed", ".json", ".mplstyle"}
    assert not [name for name in names if "peer" in name and not name.endswith("_peers.py")]
