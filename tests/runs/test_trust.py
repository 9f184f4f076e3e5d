"""``--trust``: a method in the user's own file works by an explicit word, and by nothing else."""

import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from helpers.tiny_fit import config, fails, fit, run_folder, tree, write_tiny_config
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import neurad
from neurad.callbacks import evaluation
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.runs import trust
from neurad.runs.trust import how_to_trust, import_trusted, is_trusted, split_trust

DOCS = Path(__file__).parents[2] / "docs" / "extending.md"
MARK = "open('executed', 'a').close()\n"
"""Says that a file was run."""
STEPS = ("--trainer.max_steps=2",)


def shown(language, number=0):
    """An example of the page on extending, the first one by default."""
    return re.findall(rf"```{language}\n(.*?)```", DOCS.read_text(), re.S)[number]


@pytest.fixture(autouse=True)
def _forgets():
    yield
    for name in trust._imported:
        sys.modules.pop(name, None)
    trust._imported.clear()


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A folder with the page's example, and a run of it; the file says when it is run."""
    place = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        write_tiny_config()
        Path("mine.py").write_text(MARK + shown("python"))
        Path("mine.yaml").write_text(shown("yaml"))
        fit("--config", "mine.yaml", "--trust", "mine", *STEPS)
        Path("executed").unlink()
    trust._imported.clear()
    sys.modules.pop("mine", None)
    return place


@pytest.fixture
def place(own, tmp_path, monkeypatch):
    """A copy of it as the working folder, from a process that has not run the file yet."""
    shutil.copytree(own, tmp_path / "own")
    monkeypatch.chdir(tmp_path / "own")
    return tmp_path / "own"


def test_the_example_of_the_docs(place, capfd):
    assert len([line for line in shown("python").splitlines() if line.strip()]) <= 12
    assert config()["model"]["method"] == {"class_path": "mine.Ambient", "init_args": {"ambient": 0.05}}
    assert "trust" not in config()
    main(["test", "--ckpt_path", "last", "--trust", "mine", "--trainer.enable_progress_bar=false"])
    said = capfd.readouterr().out
    assert "neurad export --ckpt_path version_0 --trust mine" in said  # what is advised is not refused
    assert (run_folder() / "metrics.json").is_file()
    run = neurad.load(trust="mine")
    assert type(run.settings.method).__name__ == "Ambient"
    assert run.settings.method.ambient == 0.05
    assert run.render(run.scene.test[0], spp=1).mean() > 0
    assert "--trust mine" in said
    main(["fit", "--ckpt_path=last", "--trust=mine", "--trainer.max_steps=3"])


def test_the_loss_of_the_docs_is_a_term_of_a_fit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_tiny_config()
    Path("paint.py").write_text(shown("python", 1))
    Path("paint.yaml").write_text("model: {method: {class_path: paint.Pale, init_args: {weight: 0.5}}}")
    monkeypatch.setattr(evaluation, "LOSSES_EVERY", 1)
    fit("--config", "paint.yaml", "--trust", "paint", *STEPS)
    events = EventAccumulator(str(next(run_folder().glob("*-pale")))).Reload()
    assert events.Scalars("more/loss_regulariser")[0].value > 0


def test_a_method_that_forgets_what_the_prior_needs_is_told_so(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_tiny_config()
    Path("mine.py").write_text(shown("python").replace("needs_field = estimates_Li", "estimates_Li"))
    Path("mine.yaml").write_text(shown("yaml"))
    words = "fit", "--config=tiny.yaml", "--config=mine.yaml", "--trust=mine", *STEPS
    said = fails(capfd, *words, alone=False, leaves=True)
    assert "method Ambient: it reads the radiance field, so what reflected gives back needs transported" in said


def test_every_door_asks_again(place, capfd):
    before = tree(place)
    for verb in ("fit", "validate", "test", "predict"):
        assert "model.method names mine.Ambient" in (said := fails(capfd, verb, "--ckpt_path=last"))
        assert "give --trust mine" in said
    for words in (
        ("export", "--ckpt_path", "last", "--out", "out"),
        ("render", "--ckpt_path", "last", "--out", "out"),
        ("view", "--ckpt_path", "last", "--port", "0"),
        ("bench", "bound", "--ckpt_path", "last"),
    ):
        if words[0] == "view":
            pytest.importorskip("viser")
        assert "give --trust mine" in fails(capfd, *words)
    with pytest.raises(InputError, match="trust='mine'"):
        neurad.load()
    said = fails(capfd, "fit", "--config=tiny.yaml", "--config=mine.yaml", *STEPS)
    assert "config mine.yaml: model.method: mine.Ambient is no class of neurad" in said
    assert "give --trust mine" in said
    assert "give --trust mine" in fails(
        capfd, "fit", "--config=tiny.yaml", "--trainer.callbacks=[mine.Ambient]", *STEPS
    )
    assert not Path("executed").exists()
    assert tree(place) == before
    # a word for one call holds for no other
    assert neurad.load(trust=["mine"]).iteration >= 2
    with pytest.raises(InputError, match="--trust mine"):
        neurad.load()
    assert "give --trust mine" in fails(capfd, "fit", "--config=tiny.yaml", "--config=mine.yaml", *STEPS)
    with pytest.raises(InputError, match="--trust mine"):
        neurad.load(trust="helpers")


def test_no_file_can_say_it(place, tmp_path, capfd, monkeypatch):
    Path("sly.yaml").write_text(yaml.safe_dump({"trust": "mine", **yaml.safe_load(shown("yaml"))}))
    said = fails(capfd, "fit", "--config=tiny.yaml", "--config=sly.yaml", *STEPS)
    assert "config sly.yaml: trust: no file can say whom you trust" in said
    Path("deep.yaml").write_text(yaml.safe_dump({"base": "sly.yaml"}))
    assert "trust: no file" in fails(capfd, "fit", "--config=tiny.yaml", "--config=deep.yaml", *STEPS)
    kept = (run_folder() / "config.yaml").read_text()
    (run_folder() / "config.yaml").write_text(f"trust: mine\n{kept}")
    assert "trust: no file" in fails(capfd, "test", "--ckpt_path=last")
    with pytest.raises(InputError, match="no file can say"):
        neurad.load()
    # somebody's run with a module of the same name in it
    (run_folder() / "config.yaml").write_text(kept)
    (run_folder() / "mine.py").write_text("raise SystemExit('hijacked')")
    assert type(neurad.load(trust="mine").settings.method).__module__ == "mine"
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--trust mine: no such module"):
        neurad.load(place / run_folder(), trust="mine")


def test_a_trusted_run_names_no_other_class(place, capfd):
    path = run_folder() / "config.yaml"
    tree = config()
    for name in ("minez.Ambient", "mine", "mine.", "os.system", "mine.Ambient; x", "torch.hub.load"):
        tree["model"]["method"]["class_path"] = name
        path.write_text(yaml.safe_dump(tree))
        said = fails(capfd, "test", "--ckpt_path=last", "--trust=mine", leaves=True)
        assert f"model.method names {name}" in said
        assert ("give --trust minez" in said) == name.startswith("minez")
    for name in ("mine.Nothing", "mine.MARK", "mine.RadianceEstimate", "mine.bounce"):
        tree["model"]["method"]["class_path"] = name
        path.write_text(yaml.safe_dump(tree))
        assert "method" in fails(capfd, "test", "--ckpt_path=last", "--trust=mine", leaves=True)


READER = """
import neurad.scene.builtin
from neurad.formats.cameras.nerf import Split
from neurad.formats.reader import Reader
class Built(Reader):
    def __init__(self, name: str = "cornell"):
        self.scene = neurad.scene.builtin.build(name)
    def surfaces(self, folder, origin):
        return self.scene
    def views(self, folder, hold_out, pictures):
        return Split(self.scene.train[:3], self.scene.test[:1])
class Lost(Built):
    def views(self, folder, hold_out, pictures):
        return []
"""
"""A reader of a folder with nothing in it."""


@pytest.fixture
def others(tmp_path, monkeypatch):
    """The working folder of a run of fields and a reader of the user's own."""
    monkeypatch.chdir(tmp_path)
    Path("room").mkdir()
    Path("plain.py").write_text(shown("python", 2))
    Path("reading.py").write_text(READER)
    kind = {"kind": {"class_path": "plain.Plain"}}
    own = {"model": dict.fromkeys(("albedo", "roughness", "radiance"), kind)}
    own["data"] = {"root": "room", "reader": {"class_path": "reading.Built"}}
    Path("own.yaml").write_text(yaml.safe_dump(own))
    write_tiny_config(base="scene.yaml")
    fit("--config=own.yaml", "--trust=plain,reading", *STEPS)


def test_fields_and_readers_by_the_same_word(others, capfd):
    main(["test", "--trust=plain,reading", "--trainer.enable_progress_bar=false"])
    assert "neurad view --ckpt_path version_0 --trust plain,reading" in capfd.readouterr().out
    run = neurad.load(trust=("plain", "reading"))
    assert run.scene.name == "room"
    assert len(run.scene.train) == 3
    for words, said in (
        ((), "names plain.Plain, which is no class of neurad.fields; if plain is your own, give --trust plain"),
        (["--trust=plain"], "data.reader names reading.Built, which is no class of neurad.formats; if reading is"),
    ):
        assert said in fails(capfd, "test", *words)
    first = ("fit", "--config=tiny.yaml", "--config=own.yaml", "--trust=plain,reading", *STEPS)
    for word, said in (
        ("--data.reader=reading.Nothing", "reading.Nothing: module 'reading' has no attribute 'Nothing'"),
        ("--data.reader=plain.Plain", "--data.reader: plain.Plain is no Reader class"),
        ("--data.reader=reading.Lost", "--data.reader: Lost.views gives back a list, not a Split"),
        ("--data.reader.init_args.names=x", "data.reader.init_args.names is not a known setting"),
        ("--model.albedo.kind=plain.Nothing", "plain.Nothing: module 'plain' has no attribute 'Nothing'"),
        ("--model.albedo.kind=reading.Built", "--model.albedo.kind: reading.Built is no Encoding class"),
    ):
        assert said in fails(capfd, *first, word, alone=False)
    own = ("fit", "--config=cornell.yaml", "--trust=reading", "--data.reader=reading.Built", *STEPS)
    assert "--data.reader: it reads a folder" in fails(capfd, *own)


def test_check_and_render_read_a_folder_by_an_own_reader(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("room").mkdir()
    Path("reading.py").write_text(READER)
    own = ["--root=room", "--data.reader=reading.Built", "--trust=reading"]
    main(["check", *own])
    assert len(Path("check/check.csv").read_text().splitlines()) == 1 + 3 + 1  # the views of the reader
    main(["render", *own, "--out=seen", "--spp=1", "--map-spp=1", "--size=8"])
    assert len([*Path("seen/images").glob("*.exr")]) == 4
    capfd.readouterr()
    for verb in ("check", "render"):
        words = [verb, "--root=room", "--out=other", "--data.reader"]
        assert "if reading is your own, give --trust reading" in fails(capfd, *words, "reading.Built")
        assert "Lost.views gives back a list, not a Split" in fails(capfd, *words, "reading.Lost", "--trust=reading")
        assert "reading.Split is no Reader class" in fails(capfd, *words, "reading.Split", "--trust=reading")
    assert "a run has the reader that it was fitted with" in fails(
        capfd, "render", "--ckpt_path=last", "--out=other", "--data.reader=reading.Built", "--trust=reading"
    )


def test_a_run_names_no_other_field_or_reader(others, capfd):
    path = run_folder() / "config.yaml"
    kept = path.read_text()
    for group, key, value in (
        ("model.albedo", "kind", "os.system"),
        ("model.albedo", "kind", {"class_path": "os.system"}),
        ("model.roughness", "kind", {"class_path": "plainz.Plain"}),
        ("data", "reader", "reading.Built"),
        ("data", "reader", {"class_path": "reading"}),
        ("model.radiance", "width", {"class_path": "plain.Plain"}),
        ("model.radiance", "kind", {"class_path": "plain.Plain", "init_args": {"x": {"class_path": "os.system"}}}),
    ):
        tree = yaml.safe_load(kept)
        place = tree
        for part in group.split("."):
            place = place[part]
        place[key] = value
        path.write_text(yaml.safe_dump(tree))
        said = fails(capfd, "test", "--trust=plain,reading")
        assert f"{group}.{key}" in said
        assert "names" in said
        with pytest.raises(InputError, match=re.escape(f"{group}.{key}")):
            neurad.load(trust="plain,reading")


def test_where_a_module_is_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    beside, elsewhere = tmp_path / "configs", tmp_path / "elsewhere"
    for folder in (beside, elsewhere, tmp_path / "pack"):
        folder.mkdir()
    (beside / "side.py").write_text("HERE = 'configs'")
    (tmp_path / "pack" / "__init__.py").write_text("")
    (tmp_path / "pack" / "inner.py").write_text("HERE = 'inner'")
    assert import_trusted(["side, pack.inner", "yaml"], [beside]) == ("side", "pack.inner", "yaml")
    assert sys.modules["side"].HERE == "configs"
    from pack import inner

    assert inner.HERE == "inner"
    first = sys.modules["side"]
    import_trusted("side", [beside])
    assert sys.modules["side"] is first
    (tmp_path / "side.py").write_text("HERE = 'here'")
    with pytest.raises(InputError, match=r"--trust side: there are several: .*/side\.py, .*configs/side\.py"):
        import_trusted("side", [beside])
    import_trusted("side")
    assert sys.modules["side"].HERE == "here"  # not the one of another folder
    (tmp_path / "yaml.py").write_text(MARK)  # takes no installed module's place
    with pytest.raises(InputError, match="--trust yaml: there are several"):
        import_trusted("yaml")
    assert not Path("executed").exists()
    (tmp_path / "odd.py").write_text("\n\n1 / 0\n")
    with pytest.raises(InputError, match=r"--trust odd: .*odd\.py, line 3: ZeroDivisionError: division by zero"):
        import_trusted("odd")
    assert "odd" not in sys.modules
    (tmp_path / "odd.py").write_text("def")
    with pytest.raises(InputError, match=r"--trust odd: .*odd\.py: SyntaxError"):
        import_trusted("odd")


@pytest.mark.parametrize("name", ["os", "subprocess", "os.path", "builtins", "pickle", "jsonargparse", "sys"])
def test_python_itself_is_never_trusted(name):
    with pytest.raises(InputError, match=f"--trust {name}: no class of Python's own modules"):
        import_trusted(name)
    assert how_to_trust(f"{name}.x") == ""


@pytest.mark.parametrize("name", ["", "mine.py", "../mine", "a b", "mine,", "mine..x", "1a", "nothing_of_this_name"])
def test_what_is_no_module(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("")
    with pytest.raises(InputError, match=r"^--trust "):
        import_trusted(name)


def test_the_words():
    assert split_trust(["--trust", "a", "--config=x", "--trust=b,c", "-h"]) == (["a", "b,c"], ["--config=x", "-h"])
    for words in (["--trust"], ["--trust", "--config=x"]):
        with pytest.raises(InputError, match="--trust needs the name"):
            split_trust(words)
    assert is_trusted("a.b.C", ["a"])
    assert is_trusted("a.b.C", ["x", "a.b"])
    assert not any(is_trusted(path, ["a.b"]) for path in ("a.C", "a.bc.C", "a.b", "a.b.", "a.b.C()"))
