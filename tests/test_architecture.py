"""The structure of the package: floors, sizes, abstract-or-final classes, documented names."""

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import pytest

import jaxctrl

ROOT = Path(jaxctrl.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
PEERS = sorted((ROOT.parent / "benchmarks").rglob("*.py"))

# Imports point strictly down, from a higher number to a lower one, or stay within a folder.
FLOORS = {
    "_version": 0,
    "_types": 0,
    "_status": 0,
    "_linalg": 0,
    "_checks": 0,
    "_fields": 0,
    "_samples": 0,
    "_bytecode": 0,
    "_recipe": 0,
    "_kinds": 0,
    "_closure": 0,
    "_function": 0,
    "_jit": 0,
    "_cpu": 0,
    "_jacobian": 0,
    "stopwatch": 0,
    "_plant": 1,
    "_function_plant": 1,
    "_terms": 1,
    "_augmented": 1,
    "_cost": 1,
    "_noise": 1,
    "_sensor": 1,
    "_delay": 1,
    "_integrate": 1,
    "linear": 1,
    "_pulses": 1,
    "_problem": 2,
    "_lifted": 2,
    "_estimator": 3,
    "_unseen": 3,
    "_controller": 3,
    "_simulate": 3,
    "_local_model": 3,
    "_prediction": 3,
    "_evaluate": 3,
    "_expand": 3,
    "plants": 3,
    "tasks": 3,
    "plot": 3,
    "analysis": 3,
    "_solver": 4,
    "_solution": 4,
    "_adjoint": 4,
    "_adjoint_expected": 4,
    "_audit": 4,
    "_files": 4,
    "_solve_checks": 3,
    "_solve": 4,
    "_batch": 4,
    "solvers": 5,
    "_check_gradients": 5,
    "problems": 5,
    "models": 6,
    "experiments": 7,
    "bench": 7,
    "cli": 8,
    "__main__": 9,
}
# On one floor, a file may import one that comes earlier here.
WITHIN = {
    0: [
        "_version",
        "_types",
        "_status",
        "_linalg",
        "_checks",
        "_fields",
        "_cpu",
        "_jacobian",
        "_bytecode",
        "_recipe",
        "_kinds",
        "_closure",
        "_function",
        "_jit",
        "stopwatch",
    ],
    1: [
        "_plant",
        "_function_plant",
        "_terms",
        "_augmented",
        "_cost",
        "_noise",
        "_sensor",
        "_delay",
        "_integrate",
        "_pulses",
    ],
    2: ["_problem", "_lifted"],
    3: [
        "_controller",
        "_estimator",
        "_unseen",
        "_solve_checks",
        "_simulate",
        "_local_model",
        "_expand",
        "_prediction",
        "_evaluate",
        "plants",
        "tasks",
    ],
    4: [
        "_solver",
        "_solution",
        "_audit",
        "_files",
        "_adjoint",
        "_adjoint_expected",
        "_solve",
        "_batch",
    ],
    5: ["solvers", "_check_gradients", "problems"],
    7: ["experiments", "bench"],
}
SOLVERS = [
    "_judging", "_damping", "_minimiser", "line_search", "_polish", "shooting", "ilqr", "ilqg",
    "ddp", "_descent", "conjugate_gradient", "lbfgs", "_hamiltonian", "_collocation",
    "boundary_value",
]  # fmt: skip


def module_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[0] if parts[0] in FLOORS else None


def imports(path):
    """Yield the parts of each jaxctrl module that a file imports, such as ("linear", "_boxqp")."""
    package = path.relative_to(ROOT.parent).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            full = base + tuple(node.module.split(".") if node.module else ())
            if full[:1] != ("jaxctrl",):
                continue
            for alias in node.names:
                yield (*full[1:], alias.name)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "jaxctrl":
                    yield tuple(alias.name.split(".")[1:])


def test_every_file_has_its_floor():
    assert {p.relative_to(ROOT).parts[0].removesuffix(".py") for p in FILES} - {"__init__"} == set(
        FLOORS
    )


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    here = module_of(path)
    if here is None:
        return
    for parts in imports(path):
        there = parts[0] if parts else None
        if there not in FLOORS or there == here:
            continue
        below = FLOORS[there] < FLOORS[here]
        order = WITHIN.get(FLOORS[here], [])
        earlier = here in order and there in order and order.index(there) < order.index(here)
        assert below or earlier, f"{here} imports {there}"


def test_linear_kernels_know_plain_arrays_alone():
    for path in (ROOT / "linear").glob("*.py"):
        for parts in imports(path):
            assert parts[0] in {"_types", "_status", "_linalg", "linear"}, (path.name, parts)


def test_solvers_import_in_one_direction():
    for name in SOLVERS:
        for parts in imports(ROOT / "solvers" / f"{name}.py"):
            others = [p for p in parts if p in SOLVERS] if parts[0] == "solvers" else []
            for other in others:
                assert SOLVERS.index(other) < SOLVERS.index(name), f"{name} imports {other}"


def chains(tree, root):
    """Yield the names after `root` in what is written root.a.b, as (a, b)."""
    inner = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and id(node) not in inner:
            names = []
            while isinstance(node, ast.Attribute):
                names, node = [node.attr, *names], node.value
            if getattr(node, "id", "") == root:
                yield tuple(names)


@pytest.mark.parametrize("path", sorted((ROOT / "experiments").glob("*.py")), ids=lambda p: p.stem)
def test_experiments_use_the_public_door_alone(path):
    """What they need a user can have: `jc.` and public names, or what lies in their own folder."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level <= 1, f"line {node.lineno} goes behind the public door"
            if not node.level and node.module.split(".")[0] == "jaxctrl":
                assert ast.unparse(node) == "from jaxctrl import __version__"
        elif isinstance(node, ast.Import):
            names = [name for name in node.names if name.name.split(".")[0] == "jaxctrl"]
            assert all((name.name, name.asname) == ("jaxctrl", "jc") for name in names)
    for names in chains(tree, "jc"):
        assert names[0] in dir(jaxctrl), f"jc.{names[0]} is no public name"
        room = getattr(jaxctrl, names[0])
        if inspect.ismodule(room):
            assert hasattr(room, names[1]) and not names[1].startswith("_"), names


@pytest.mark.parametrize("path", FILES + PEERS, ids=lambda p: str(p.relative_to(ROOT.parent)))
def test_files_and_functions_stay_small(path):
    text = path.read_text()
    assert text.count("\n") <= 400, "a file over 400 lines wants to be two"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            lines = node.end_lineno - body[0].lineno + 1 if body else 0
            assert lines <= 60, f"{node.name}: {lines} lines"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_library_leaves_configuration_and_output_to_the_application(path):
    if path.name == "cli.py" or {"experiments", "bench"} & set(path.relative_to(ROOT).parts):
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            assert not (node.attr == "config" and getattr(node.value, "id", "") == "jax")
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print":
            raise AssertionError("the library never prints")


def test_importing_every_module_makes_no_array():
    """An array made at import would fix float32 before the application enables x64."""
    modules = [m.name for m in walk() if not m.name.startswith("jaxctrl.cli")]
    code = (
        "import importlib, jax\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "assert not jax.live_arrays(), jax.live_arrays()\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_jnp_call_at_import(path):
    def scan(nodes):
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.Lambda):
                scan(node.decorator_list if isinstance(node, ast.FunctionDef) else [])
                continue
            if isinstance(node, ast.Call):
                root = node.func
                while isinstance(root, ast.Attribute):
                    root = root.value
                assert getattr(root, "id", "") != "jnp", f"line {node.lineno}"
            scan(ast.iter_child_nodes(node))

    scan(ast.parse(path.read_text()).body)


def walk():
    return list(pkgutil.walk_packages([str(ROOT)], "jaxctrl."))


def classes():
    seen = {}
    for info in walk():
        for value in vars(importlib.import_module(info.name)).values():
            own = inspect.isclass(value) and value.__module__.startswith("jaxctrl")
            if own and issubclass(value, eqx.Module):
                seen[value] = None
    return list(seen)


def test_classes_are_abstract_or_final():
    for cls in classes():
        bases = [b for b in cls.__mro__[1:] if b.__module__.startswith("jaxctrl")]
        for base in bases:
            assert base.__name__.startswith("Abstract"), (
                f"{cls.__name__} subclasses {base.__name__}"
            )
            for name, value in vars(base).items():
                concrete = callable(value) and not getattr(value, "__isabstractmethod__", False)
                if concrete and not name.startswith("_"):
                    assert name not in vars(cls), f"{cls.__name__} overrides {base.__name__}.{name}"


def public():
    found = {}
    own = [value for name in dir(jaxctrl) if inspect.ismodule(value := getattr(jaxctrl, name))]
    for module in (jaxctrl, *own):
        names = getattr(module, "__all__", None) or [n for n in vars(module) if n[0] != "_"]
        for name in names:
            value = getattr(module, name)
            if getattr(value, "__module__", "").startswith("jaxctrl"):
                found[f"{module.__name__}.{name}"] = value
    return found


@pytest.mark.parametrize("name", public())
def test_public_names_are_documented_with_shapes(name):
    value = public()[name]
    doc = inspect.getdoc(value)
    assert (doc and doc.splitlines()[0].endswith((".", ":"))) or "." in doc.splitlines()[1], name
    if inspect.isclass(value):
        for method, member in vars(value).items():
            if not method.startswith("_") and (callable(member) or isinstance(member, property)):
                assert inspect.getdoc(member), f"{name}.{method}"
    else:
        annotations = inspect.signature(value).parameters.values()
        arrays = any(
            "Float" in str(p.annotation) or "Array" in str(p.annotation) for p in annotations
        )
        assert not arrays or "(" in doc or "reach" in doc, f"{name} names no shapes"


def test_table_of_contents_is_complete():
    stub = ast.parse((ROOT / "__init__.pyi").read_text())
    listed = [alias.asname for node in stub.body for alias in getattr(node, "names", ())]
    assert sorted(listed) == dir(jaxctrl) == jaxctrl.__all__, "each name is listed once"
    assert [name for name in listed if name.startswith("_")] == ["__version__"]
    for name in listed:
        assert getattr(jaxctrl, name) is not None
    rooms = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert rooms - set(listed) == {"bench", "solvers"}, "a folder is public, or said not to be"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        getattr(jaxctrl, "non" + "sense")
