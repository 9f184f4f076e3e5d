"""Lamps whose radiance is not known: what photographs say of it before training, and while materials get known."""

from collections.abc import Sequence

import numpy as np
import torch

from neurad.assembly.build import Assembly
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import BoolArray, PixelBatch
from neurad.core.rng import mix
from neurad.integrators.primary_hits import PrimaryHits
from neurad.lamps.clipped import known_lamps_brightness, sentence
from neurad.lamps.photographed import LampPhotographs, photographed_lamps, reflected_by_lamp
from neurad.lamps.responses import Responses, connected, indistinguishable, lamp_responses, nonnegative_least_squares
from neurad.runtime.progress import say
from neurad.runtime.reading import listed
from neurad.runtime.tables import align

ALL = "--model.lighting.emitters"
FIRST, EVERY = 64, 4096
"""What lamps reflect is estimated anew after so many iterations, whenever their number has doubled, and at multiples
of the second."""
COLUMNS = ("mesh", "r", "g", "b", "pixels", "views", "clipped", "scale")
"""Columns of ``lamps.csv``. The ``scale`` is ``seen`` in unclipped pixels of the lamp's own, ``shared`` where its light
falls where light of fixed scale does, and else ``weak``."""


def begin_lamps(
    assembly: Assembly, primary: PrimaryHits, photographs: PhotoSource, shown: LampPhotographs, sample: PixelBatch
) -> None:
    """Let the photographs say how bright each lamp is, and print it.

    Lamps that some pixel shows alone and unclipped get what these pixels show, less what the lamp reflects; those that
    photographs clip what they light says (:mod:`neurad.lamps.clipped`), and so do, with ``model.lighting.emitters``
    ``fit`` or ``find``, those that no pixel shows. What is left, under an environment that is not known either above
    all, gets with these two what explains the photographs of surfaces best: pictures lit by one lamp at a time,
    non-negative least squares.

    Args:
        shown: what photographs show of lamps alone.
        sample: random photographed pixels that show no emitter.

    Raises:
        InputError: with ``photographs``: none of them says how bright a lamp is.
    """
    lamps, scene = assembly.lamps, assembly.scene
    assert lamps is not None
    seed, train = assembly.settings.seed, assembly.settings.lighting.fits_lamps
    cameras = [view.camera for view in scene.train]
    developed = shown.developed(assembly.development)
    measured = photographed_lamps(scene, assembly.world, assembly.materials, cameras, developed, seed)
    lamps.photographed.copy_(torch.from_numpy(np.nan_to_num(np.stack([m.photographed for m in measured]))))
    lamps.counts.copy_(torch.tensor([[m.pixels, m.views, m.clipped] for m in measured]))
    names, observed = [m.name for m in measured], lamps.unclipped.cpu().numpy() > 0
    radiance = np.stack([m.radiance if seen else m.declared for m, seen in zip(measured, observed, strict=True)])
    lamps.set_radiance(radiance)
    known, lines = observed.copy(), list[str]()
    if off := [mesh.name for mesh in scene.meshes if mesh.radiance is not None and not mesh.radiance.any()]:
        lines.append(
            f"warning: {_names(off)}: the radiance is 0 in the scene, so nothing is recovered; give any above 0"
        )
    if assembly.settings.lighting.emitters == "find":  # of clipped lamps by what they light
        known |= np.array([scene.meshes[i].radiance_known for i in lamps.mesh.tolist()])
    responses = None
    if train and not observed.all():
        sample = sample if assembly.development is None else assembly.development(sample)
        responses = lamp_responses(assembly, primary, sample, seed)
        known |= ~responses.reaches
        lines += _said_of(responses, known, observed, names)
    left = [row for row in np.flatnonzero(~known).tolist() if train or measured[row].pixels]
    if left and assembly.environment is None:
        for row, found in known_lamps_brightness(assembly, photographs, left, radiance).items():
            radiance[row], known[row] = found.radiance.double().cpu().numpy(), True
            lines.append(sentence(f"lamp {names[row]}", found.radiance, found.error, measured[row].pixels > 0))
    if responses is not None:
        if rest := [m.name for m, is_known in zip(measured, known, strict=True) if m.pixels and not is_known]:
            lines.append(f"{_names(rest)}: clipped in every photograph, so pictures lit by it say how bright it is")
        begun = nonnegative_least_squares(responses, radiance, known, indistinguishable(responses, known))
        radiance = np.where(known[:, None], radiance, begun)
        lamps.scale_seen.copy_(torch.from_numpy(connected(responses, radiance, observed)))
    else:
        if not known.any():
            why = (
                "in every photograph that shows a lamp half of its pixels or more are clipped"
                if any(m.pixels for m in measured)
                else "no photograph shows a lamp alone in a pixel"
            )
            raise InputError(
                f"scene {scene.name}: {why}, so {ALL} photographs has nothing to go by; take fit, or known with "
                "radiance in scene.xml"
            )
        lamps.scale_seen.copy_(torch.from_numpy(observed))
        if not known.all():
            hidden = _names([name for name, is_known in zip(names, known, strict=True) if not is_known])
            lines.append(
                f"warning: no photograph shows {hidden} unclipped, so the scene's radiance holds there; {ALL} fit "
                "recovers it"
            )
    lamps.set_radiance(radiance)
    refresh_lamps(assembly, shown, 0)
    lamps.begun.fill_(True)
    say(*align(body(assembly)), *lines)


@torch.no_grad()
def refresh_lamps(assembly: Assembly, shown: LampPhotographs, iteration: int) -> None:
    """Estimate anew what lamps reflect of all light, with the present materials, and what photographs of them show as
    they are developed by now; with ``photographs`` the radiance follows, with ``fit`` what holds it to the photographs.
    The iterations done are the key of the random numbers.
    """
    lamps, world = assembly.lamps, assembly.world
    assert lamps is not None
    cameras = [view.camera for view in assembly.scene.train]
    observed, radiance = lamps.unclipped.cpu().numpy() > 0, lamps.found()
    reflected = np.zeros_like(radiance)
    for row in np.flatnonzero(observed):
        index = int(lamps.mesh[row])
        key = mix(assembly.settings.seed, index, iteration)
        reflected[row] = reflected_by_lamp(world, assembly.materials, cameras, shown.at, index, key)
    lamps.reflected.copy_(torch.from_numpy(reflected))
    if assembly.development is not None:
        developed = shown.developed(assembly.development)
        for row in np.flatnonzero(observed):
            lamps.photographed[row] = torch.from_numpy(developed.radiance(int(lamps.mesh[row])))
    if iteration == 0 or not lamps.values.requires_grad:
        photographed = lamps.photographed.double().cpu().numpy()
        factor = photographed / np.maximum(radiance + reflected, 1e-30)  # what is too bright is reflected so, too
        lamps.set_radiance(np.where(observed[:, None], radiance * factor, radiance))


def should_refresh(iteration: int) -> bool:
    """Whether :func:`refresh_lamps` is called after this many iterations; they alone decide."""
    doubled = iteration >= FIRST and iteration & (iteration - 1) == 0
    return doubled or (iteration > 0 and iteration % EVERY == 0)


def rows(assembly: Assembly) -> list[dict[str, str | int | float]]:
    """A row of ``lamps.csv`` for each lamp of a run that recovers them, or for a flash whose power it recovers; none
    otherwise.
    """
    lamps, flash, light = assembly.lamps, assembly.world.flash, assembly.scene.flash
    if flash is not None and light is not None and flash.gain.requires_grad:
        found = (light.intensity * flash.factor().detach().cpu().numpy()).tolist()
        views = sum(view.camera.flash is not None for view in assembly.scene.train)
        return [dict(zip(COLUMNS, (light.name, *found, 0, views, 0, "weak"), strict=True))]
    if lamps is None:
        return []
    names = [assembly.scene.meshes[index].name for index in lamps.mesh.tolist()]
    scales = [
        "seen" if own > 0 else "shared" if fixed else "weak"
        for own, fixed in zip(lamps.unclipped.tolist(), lamps.scale_seen.tolist(), strict=True)
    ]
    parts = zip(names, lamps.found().tolist(), lamps.counts.tolist(), scales, strict=True)
    return [dict(zip(COLUMNS, (name, *rgb, *counts, scale), strict=True)) for name, rgb, counts, scale in parts]


def body(assembly: Assembly) -> list[list[str]]:
    """Cells about each lamp of such a run: radiance and what shows it, a row each, headings first; none otherwise."""
    found = rows(assembly)
    cells = [[f"{row[name]:.4g}" if name in ("r", "g", "b") else str(row[name]) for name in COLUMNS] for row in found]
    return [["lamp", *COLUMNS[1:]], *cells] if cells else []


def _said_of(responses: Responses, known: BoolArray, observed: BoolArray, names: Sequence[str]) -> list[str]:
    """What there is to say of lamps [m] that light nothing, and of those not ``known`` that light the same."""
    lines = []
    dark = [name for name, lit, seen in zip(names, responses.reaches, observed, strict=True) if not lit and not seen]
    if dark:
        lines.append(
            f"warning: the light of {_names(dark)} reaches no surface that the photographs show, so nothing says how "
            "bright it is: the scene's radiance holds"
        )
    for group in indistinguishable(responses, known):
        if len(group) > 1:
            lines.append(
                f"warning: {_names([names[i] for i in group])} light what the photographs show alike, so these hardly "
                "tell them apart: trust their sum more than each"
            )
    return lines


def _names(names: Sequence[str]) -> str:
    return f"{'lamps' if len(names) > 1 else 'lamp'} {listed(names)}"
