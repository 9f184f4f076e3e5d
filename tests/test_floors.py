"""Imports only go down the floors, and nothing within a floor imports in a circle."""

import ast
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
FLOORS = [
    {"core"}, {"runtime"}, {"tracing"}, {"scene"}, {"bsdf"}, {"emitters"}, {"fields"}, {"optim"}, {"losses"},
    {"integrators"},
    {"metrics"}, {"assembly"}, {"training"}, {"callbacks"}, {"runs"}, {"studies"}, {"commands"}, {"cli"}, {"__main__"},
]  # fmt: skip
FLOOR = {name: level for level, names in enumerate(FLOORS) for name in names}


def imported(source: str) -> set[str]:
    """Modules that a source file imports, inside functions too; what is only for type checkers is left out."""
    tree = ast.parse(source)
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


def sources() -> dict[str, str]:
    """Text by dotted module name."""
    found = {}
    for top in ("neurad", "datamodules"):
        for path in sorted((REPOSITORY / top).rglob("*.py")):
            parts = list(path.relative_to(REPOSITORY).with_suffix("").parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text()
    return found


def violations(files: dict[str, str]) -> list[str]:
    """Imports that go up, sideways between floors of one level, or reach for the data modules."""
    bad = []
    for name, text in files.items():
        floor = name.split(".")[1] if name.startswith("neurad.") else name.split(".")[0]
        for target in imported(text):
            parts = target.split(".")
            if parts[0] == "datamodules" and not name.startswith(("datamodules", "neurad.cli")):
                bad.append(f"{name} imports {target}")
            if parts[0] != "neurad" or len(parts) < 2 or parts[1] not in FLOOR:
                continue
            allowed = (
                parts[1] in ("core", "runtime", "scene")
                if floor == "datamodules"
                else floor == parts[1] or (floor in FLOOR and FLOOR[parts[1]] < FLOOR[floor])
            )
            if not allowed or (floor == "scene" and parts[1] == "tracing"):
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


def test_imports_go_down():
    assert violations(sources()) == []


def test_no_cycle():
    assert cycle(sources()) == []


def test_every_floor_is_known():
    folders = {p.name for p in (REPOSITORY / "neurad").iterdir() if (p / "__init__.py").is_file()}
    assert folders <= set(FLOOR)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("neurad.core.rng", "from neurad.scene.description import Scene"),
        ("neurad.scene.load", "def f():\n    import neurad.tracing.embree"),
        ("neurad.losses.relative", "from neurad.metrics import scores"),
        ("neurad.training.inverse", "from datamodules.scene_data import SceneData"),
        ("datamodules.scene_data", "from neurad.fields import hash_grid"),
    ],
)
def test_a_wrong_arrow_is_found(name, text):
    assert len(violations({name: text})) >= 1


def test_a_cycle_is_found():
    files = {"neurad.core.a": "import neurad.core.b", "neurad.core.b": "def f():\n    from neurad.core import a"}
    assert cycle(files) == ["neurad.core.a", "neurad.core.b", "neurad.core.a"]
    assert cycle({"neurad.core.a": "", "neurad.core.b": "import neurad.core.a"}) == []
