"""Imports only go down the floors, nothing imports in a circle, and no import is hidden in a string."""

import ast
import re
from functools import cache
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
FLOORS = (
    "core", "runtime", "tracing", "images", "scene", "formats", "bsdf", "emitters", "fields", "optim", "losses",
    "integrators", "metrics", "evidence", "assembly", "lamps", "checkpoints", "training", "pages", "export",
    "callbacks", "runs", "inspect", "compare", "commands", "benchmarks", "cli", "__main__",
)  # fmt: skip
"""Folders and modules of neurad, and benchmarks beside it, from the lowest to the highest: each imports those below."""
LEVEL = {name: level for level, name in enumerate(FLOORS)}
DATA_MODULES_USE = ("core", "runtime", "images", "scene", "formats")
DATA_MODULES_FROM = LEVEL["compare"]
"""The lowest floor that may name the data modules; below it they stand behind a Protocol of core."""
HIDDEN = re.compile(
    r"\bneurad\.(?:$|" + "|".join(f"{floor}\\b" for floor in FLOORS) + r")|\b(?:datamodules|benchmarks)\.\w"
)
"""A module's path in a string. The name ``neurad`` alone is the program."""
LOADERS = ("import_module", "__import__", "run_module", "run_path")


@cache
def imported(source: str) -> set[str]:
    """Modules that a source file imports, inside functions too; what is only for type checkers is left out."""
    return targets(ast.parse(source))


def targets(tree: ast.Module) -> set[str]:
    """Modules that a syntax tree imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports are not used here"
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    return names


def hidden(source: str) -> list[str]:
    """Imports that a source file hides in strings: module paths outside docstrings, and modules loaded by name."""
    tree = ast.parse(source)
    documentation = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            found += [node.value] if HIDDEN.search(node.value) else []
        elif isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", None))
            found += [ast.unparse(node)] if called in LOADERS else []
    return found


@cache
def sources() -> dict[str, str]:
    """Text by dotted module name."""
    found = {}
    for top in ("neurad", "datamodules", "benchmarks"):
        for path in sorted((REPOSITORY / top).rglob("*.py")):
            parts = list(path.relative_to(REPOSITORY).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text()
    return found


def floor_of(name: str) -> str:
    """The floor of a module: 'neurad' itself, which is the Python door, 'datamodules', or a name of FLOORS."""
    parts = name.split(".")
    return parts[1] if parts[0] == "neurad" and len(parts) > 1 else parts[0]


def at_import(source: str) -> set[str]:
    """Modules that a source file imports when it is imported itself: not inside its functions."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.body = []
    return targets(tree)


def is_allowed(importer: str, target: str) -> bool:
    """Whether a module on the floor ``importer`` may import from the floor ``target``."""
    if importer == target:
        return True
    if importer == "datamodules":
        return target in DATA_MODULES_USE
    if target == "datamodules":
        return LEVEL.get(importer, 0) >= DATA_MODULES_FROM
    if importer == "neurad":  # ``neurad.load``
        return LEVEL[target] <= LEVEL["runs"]
    return LEVEL[target] < LEVEL[importer] and not (importer in ("images", "scene", "formats") and target == "tracing")


def violations(files: dict[str, str]) -> list[str]:
    """Imports that go up, or across where that is not allowed."""
    bad = []
    for name, text in files.items():
        for target in imported(text):
            top, _, attribute = target.partition(".")
            if top not in ("neurad", "datamodules", "benchmarks"):
                continue
            floor = floor_of(target)
            if top == "neurad" and floor not in LEVEL:  # the package itself, or something that it defines
                if attribute not in ("", "__version__") and LEVEL.get(floor_of(name), -1) <= LEVEL["runs"]:
                    bad.append(f"{name} imports {target}")
            elif not is_allowed(floor_of(name), floor):
                bad.append(f"{name} imports {target}")
    return bad


def cycle(files: dict[str, str]) -> list[str]:
    """A circle of modules that import each other, or nothing."""
    graph = {name: {t for t in imported(text) if t in files and t != name} for name, text in files.items()}
    done: set[str] = set()

    def visit(name: str, trail: list[str]) -> list[str]:
        if name in trail:
            return [*trail[trail.index(name) :], name]
        if name in done:
            return []
        for target in sorted(graph[name]):
            # ``from package import module`` inside that package is no circle: the package's __init__ comes first.
            if name.startswith(target + "."):
                continue
            if found := visit(target, [*trail, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(graph) if (found := visit(name, []))), [])


def test_imports_go_down_without_cycles_and_none_hides_in_a_string():
    assert violations(sources()) == []

    assert cycle(sources()) == []

    assert {name: found for name, text in sources().items() if (found := hidden(text))} == {}

    folders = {p.name for p in (REPOSITORY / "neurad").iterdir() if (p / "__init__.py").is_file()}
    assert folders <= set(FLOORS)


def test_the_package_does_without_benchmarks():
    files = {name: at_import(text) for name, text in sources().items() if name.split(".")[0] != "benchmarks"}
    assert [name for name, targets in files.items() if any(floor_of(t) == "benchmarks" for t in targets)] == []


def test_no_test_file_imports_another():
    for path in (REPOSITORY / "tests").rglob("test_*.py"):
        parts = {part for target in imported(path.read_text()) for part in target.split(".")}
        assert not [part for part in parts if part.startswith("test_")], path.name


def test_commands_are_thin():
    texts = [path.read_text() for path in (REPOSITORY / "neurad" / "commands").glob("*.py")]
    assert sum(text.count("\n") for text in texts) < 1500


def test_what_is_wrong_is_found():
    wrong = {
        "neurad.core.rng": "from neurad.scene.description import Scene",
        "neurad.losses.relative": "from neurad import load",
        "neurad.training.inverse": "from datamodules.scene_data import SceneData",
        "neurad.inspect.film": "def f():\n    from benchmarks.bench import step",
        "datamodules.scene_data": "from neurad.fields import hash_grid",
    }
    assert len(violations(wrong)) >= len(wrong)
    assert len(hidden("import_module(f'{__name__}.{name}')\nX = 'neurad.commands.render'")) == 2
    assert hidden('"""See neurad.core.rng."""\nprint("neurad: error")\nNAMES = ["-m", "neurad"]') == []
    files = {"neurad.core.a": "import neurad.core.b", "neurad.core.b": "def f():\n    from neurad.core import a"}
    assert cycle(files) == ["neurad.core.a", "neurad.core.b", "neurad.core.a"]
