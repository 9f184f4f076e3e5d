"""``neurad check``: look at a scene before a fit does."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from neurad.assembly.build import build_world
from neurad.core.errors import InputError
from neurad.emitters.lights import NullEmitter
from neurad.evidence.edge_fit import misfits
from neurad.formats.load import load_scene
from neurad.formats.reader import Reader
from neurad.images.development import Photography
from neurad.images.picture_notes import say_pictures
from neurad.inspect.check.findings import Findings, Level
from neurad.inspect.check.geometry import check_holes, check_places, check_units
from neurad.inspect.check.hints import FEWEST, explanation, turned
from neurad.inspect.check.light import SEED, Light, Source, add_line, check_light, lamp_power, usable
from neurad.inspect.check.look import LEVELS, Looked, look
from neurad.inspect.check.report import PAGE, TABLE, Checked, verdict, write_pages
from neurad.integrators.world import World
from neurad.lamps.find import find_lamps
from neurad.lamps.photographed import CEILINGS
from neurad.metrics.seen import SeenBy
from neurad.runtime.files import check_folder, make_folder
from neurad.runtime.progress import phase
from neurad.runtime.reading import listed
from neurad.scene.description import Scene
from neurad.scene.origin import place_text
from neurad.scene.shining import shining_scene
from neurad.training.prepared_scene import refined_poses

CLIPPED, AT_CEILING = 0.005, 0.001
"""Fraction of the pixels at the largest value of a photograph that is too much, and where that is one of a format."""
KNOWN_CEILING = 0.5
"""Fraction of the pixels at the largest value that is too much where a fit knows the ceiling."""
BLACK = 0.05
"""Fraction of the pixels of surfaces that may be exactly 0."""
HINTS = 8
"""Views of which it is looked for what would make them fit."""


def check(
    root: str | None,
    name: str | None,
    reader: Reader | None,
    source: Source,
    emitters: str,
    exposure: Literal["known", "fit"],
    out: Path,
    overwrite: bool,
) -> None:
    """Check a scene folder, or the built-in scene of a name, write the page and the table, and print what was found.

    Args:
        emitters: what a fit will take as known of area lights, and ``exposure`` of exposures.

    Raises:
        InputError: it cannot be read, or a file would be written over.
        SystemExit: with 1 if something is wrong. Of what a fit would refuse an InputError is raised, after the page is
            written.
    """
    check_folder(out, "--out")
    if not overwrite and (found := [p for p in (PAGE, TABLE) if (out / p).exists()]):
        raise InputError(f"--out: {out / found[0]} is there already; add --overwrite to write over it")
    scene = load_scene(root, name, photography=Photography(exposure=exposure), reader=reader)
    if not any(view.image for view in scene.train):
        raise InputError(f"scene {scene.name}: it has no training photographs")
    checked = checked_scene(scene, source, emitters)
    make_folder(out, "--out")
    write_pages(checked, out)
    _say(checked, out)
    findings = checked.findings
    if refused := findings.of(Level.REFUSED):
        more = f" ({len(refused) - 1} more on the page)" if len(refused) > 1 else ""
        raise InputError(refused[0].text + more)
    if findings.worst == Level.WRONG:
        raise SystemExit(1)


def checked_scene(scene: Scene, source: Source, emitters: str = "known") -> Checked:
    """Check a scene."""
    findings = Findings()
    dark = ""
    try:
        if emitters == "find":
            shown = source(scene)
            posed = refined_poses(scene, shown, "embree", SEED)[0]  # as a fit does first; the page shows those given
            found = find_lamps(posed, shown, "embree", False, SEED)
            scene = shining_scene(scene, found.lamps)
            for line in found.lines:
                add_line(findings, line)
        world = build_world(scene)
    except InputError as error:  # what else is wrong may be why nothing shines
        dark = str(error)
        world = build_world(scene, lights=NullEmitter())
    for note in (*scene.notes, *filter(None, [scene.scores_are_of])):
        findings.add(Level.NOTE, "scene", note)
    seen_by = SeenBy.of(world.geometry, world.tracer, scene.train)
    looked: list[Looked] = []
    with phase("checking", len(scene.train) + len(scene.test)) as checking, world.tracer.uncounted():
        for part, views in (("train", scene.train), ("held out", scene.test)):
            for view in views:
                checking.detail = view.name
                seen = seen_by if part == "held out" else None
                looked.append(look(world, view, part, seen, len(looked)))
                checking.step()
        say_pictures()
        check_units(scene, world, looked, findings)
        check_holes(scene, looked, findings)
        _photographs(looked, findings)
        _edges(world, looked, findings)
        places = check_places(scene, world, looked, seen_by, findings)
    with phase("rendering"):
        good = usable(scene, [one.view.name for one in looked if one.refused])
        bare = Light(lamp_power(scene, world))
        edges = [
            (one.ranks, one.camera, one.towards)
            for one in looked
            if one.part == "train" and one.ranks is not None and one.camera is not None
        ]
        lit = good.train and not dark
        light = check_light(good, world, source, findings, emitters, edges) if lit else bare
    if dark and not findings.of(Level.REFUSED):
        findings.add(Level.REFUSED, "lamp", dark)
    return Checked(scene.name, _subject(scene, world, light), looked, places, light, findings)


def _subject(scene: Scene, world: World, light: Light) -> dict[str, str]:
    """How large a scene is; its power is that of all lamps, the mean of their channels."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in (*scene.train, *scene.test)})
    said = ", ".join(f"{w} x {h}" for w, h in sizes[:4]) + (f" and {len(sizes) - 4} more" if len(sizes) > 4 else "")
    sky = scene.environment
    around = "none"
    if sky is not None:
        around = f"{sky.pixels.shape[1]} x {sky.pixels.shape[0]}, up to {sky.pixels.max():.3g}"
    lamps, power = len(light.power), sum(lamp[3] for lamp in light.power)
    box = " to ".join(f"({place_text(corner)})" for corner in (scene.bounds + scene.origin).tolist())
    return {
        "triangles, meshes, materials": f"{len(world.geometry.faces)}, {len(scene.meshes)}, {len(scene.materials)}",
        "bounds": f"{box}, {2.0 * world.geometry.scale:.4g} units across",
        "lamps": f"{lamps}, power {power:.4g} (pi times area times radiance)" if lamps else "none",
        "environment": around,
        "views": f"{len(scene.train)} to learn from, {len(scene.test)} held out, of {said} pixels",
    }


def _photographs(looked: Sequence[Looked], findings: Findings) -> None:
    """Say which photographs have bad pixels."""
    for one in looked:
        name, facts = one.view.name, one.facts
        if one.refused:
            findings.add(Level.REFUSED, "photograph", one.refused, name)
        if facts is None:
            continue
        if facts.constant:
            findings.add(Level.WRONG, "photograph", "all pixels of its photograph are equal", name)
            continue
        development = one.view.development
        usual = AT_CEILING if facts.highest in CEILINGS else CLIPPED
        if facts.clipped > (usual if development.ceiling is None else KNOWN_CEILING):
            findings.add(
                Level.WRONG, "photograph",
                f"its photograph is clipped: {100 * facts.clipped:.1f} % of the pixels without lamps have its largest "
                "value; their light is lost", name,
            )  # fmt: skip
        elif development.levels == 0 and facts.levels is not None and facts.levels <= LEVELS:
            findings.add(
                Level.WRONG, "photograph",
                f"its photograph has {facts.levels} different values, as one of 8 bits: it must be linear, of high "
                "dynamic range", name,
            )  # fmt: skip
        if facts.black > BLACK:
            findings.add(
                Level.WRONG, "photograph", f"{100 * facts.black:.0f} % of its pixels that show surfaces are 0", name
            )


def _edges(world: World, looked: Sequence[Looked], findings: Findings) -> None:
    """Say which photographs do not show the edges of the geometry where their cameras see them."""
    able = [one.facts is not None and not one.facts.constant for one in looked]
    fits = [
        one.fit if ok and one.fit is not None and one.fit.places >= FEWEST else None
        for one, ok in zip(looked, able, strict=True)
    ]
    wrong = misfits(fits)
    words: dict[int, str] = {}
    usual = float(np.median([fit.here for fit in fits if fit is not None])) if any(fits) else 0.0
    for index in wrong:
        fit = fits[index]
        assert fit is not None
        if len(words) < HINTS:
            words[index] = explanation(world, looked[index], looked) or turned(fit)
        why = (
            f"edge rank {fit.here:.2f}, of all views {usual:.2f}"
            if fit.fits
            else f"turned cameras fit better (edge rank {fit.here:.2f}, excess {fit.excess:.1f})"
        )
        _misfit(looked[index], why, words.get(index, ""), findings)
    blank = [index for index, ok in enumerate(able) if ok and fits[index] is None]
    explained = {index: text for index in blank[:HINTS] if (text := explanation(world, looked[index], looked))}
    for index, text in explained.items():
        _misfit(looked[index], "it sees next to none", text, findings)
    if unknown := [looked[index].view.name for index in blank if index not in explained]:
        findings.add(Level.NOTE, "edges", f"next to no edges are in sight of {listed(unknown, 6)}: they are not judged")
    bad = len({*wrong, *explained})
    judged = len(looked) - len(unknown) - able.count(False)
    if 2 * bad > judged > 0:
        causes = sorted({text for text in (words | explained).values() if text and "turned by about" not in text})
        said = f" ({listed(causes, 2)})" if causes else ""
        findings.add(
            Level.WRONG,
            "edges",
            f"most photographs ({bad} of {judged} that can be judged) do not fit the geometry: look at the frame and "
            f"scale of the cameras, and whether these are its photographs{said}",
        )


def _misfit(one: Looked, why: str, instead: str, findings: Findings) -> None:
    findings.add(
        Level.WRONG,
        "edges",
        f"its photograph does not show the edges of the geometry where the camera sees them: {why}"
        f"{f'; {instead}' if instead else ''}",
        one.view.name,
    )


def _say(checked: Checked, out: Path) -> None:
    findings = checked.findings
    print(*(f"{label}: {value}" for label, value in checked.subject.items()), sep="\n")
    for finding in (*findings.of(Level.NOTE), *findings.of(Level.WRONG), *findings.of(Level.REFUSED)):
        print(f"{'wrong' if finding.level > Level.NOTE else 'note'}: {finding.text}")
    print(f"{verdict(findings)} Look at {out / PAGE}; {out / TABLE} has a row a view.")
