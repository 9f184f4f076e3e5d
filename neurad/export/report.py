"""The page on what the verification found: figures and pictures side by side, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
import html
from pathlib import Path

import numpy as np

from neurad.core.records import FloatArray
from neurad.export.images import eight_bits, png
from neurad.export.verify import Verified
from neurad.scene.image_io import to_srgb

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 1400px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { padding: .2em .7em; text-align: right; }
th:first-child, td:first-child { text-align: left; } tr { border-bottom: 1px solid #ddd; }
figure { display: inline-block; margin: 0 .4em .8em 0; } img { width: 256px; height: auto; }
figcaption { font-size: 13px; color: #555; } .beyond { color: #a40000; }
"""
DIFFERENCE = 10.0
"""Times that differences are enlarged."""


def write_report(found: Verified, path: Path, title: str) -> None:
    """Write the page.

    Raises:
        OSError: it cannot be written.
    """
    said = found.as_json()
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body><h1>{html.escape(title)}</h1>",
        f"<p>Verified on {html.escape(said['verified_on'])}.</p>",
        *(f'<p class="beyond">{html.escape(text)}</p>' for text in found.beyond),
        *(f"<p>Left out: {html.escape(text)}.</p>" for text in found.left_out),
        _scores(found),
        _renderers(said["renderers"]),
    ]
    for index, view in enumerate(found.views):
        parts.append(f"<h2>{html.escape(view.name)}</h2>")
        photo = found.photographs[index]
        shown = {name: pictures.mean[index] for name, pictures in found.pictures.items()}
        pictures = {**({} if photo is None else {"photograph": photo}), **shown}
        top = max(float(np.quantile(pictures["baked"], 0.97)), 1e-12)
        for name, picture in pictures.items():
            parts.append(_figure(name, picture / top))
        for name in shown:
            if name != "baked":
                off = np.abs(shown[name] - shown["baked"]) * (DIFFERENCE / top)
                parts.append(_figure(f"{name} - baked, x {DIFFERENCE:g}", off))
    path.write_text("\n".join(parts) + "</body></html>\n", encoding="utf-8")


def _scores(found: Verified) -> str:
    rows = "".join(f"<tr><td>{html.escape(k)}</td><td>{v:.2f} dB</td></tr>" for k, v in found.scores.items())
    return f"<h2>Baking</h2><table>{rows}</table>"


def _renderers(renderers: dict[str, dict[str, object]]) -> str:
    head = "<tr><th>renderer</th><th>PSNR (linear)</th><th>mean / ours</th><th>worst view</th></tr>"
    rows = []
    for name, entry in renderers.items():
        score, worst = entry["psnr_linear"], entry["worst_view"]
        assert isinstance(worst, dict)
        shown = "-" if not isinstance(score, float) else f"{score:.2f} dB"
        last = f"{html.escape(str(worst['name']))}: {worst['ratio_of_means']:.4f}"
        rows.append(f"<tr><td>{name}</td><td>{shown}</td><td>{entry['ratio_of_means']:.4f}</td><td>{last}</td></tr>")
    return f"<h2>Renderers</h2><table>{head}{''.join(rows)}</table>"


def _figure(caption: str, picture: FloatArray) -> str:
    data = base64.b64encode(png(eight_bits(to_srgb(picture)))).decode("ascii")
    name = html.escape(caption)
    return f'<figure><img alt="{name}" src="data:image/png;base64,{data}"><figcaption>{name}</figcaption></figure>'
