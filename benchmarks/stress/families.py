"""The families of cases. They stand apart from the cases, which import torch, so that ``neurad stress -h`` is fast."""

FAMILIES: dict[str, str] = {
    "stiff": "albedo near 1: the field alone, its speed, and recovering the albedo",
    "surfaces": "roughness and albedo at the ends of their range",
    "light": "very bright, very dim and very small lights",
    "images": "black, scaled and corrupted photographs",
    "shapes": "size and place of the scene, bad triangles, huge meshes",
    "delta": "glass and mirrors",
    "precision": "float32 against float64, other number formats, many seeds, long runs",
    "guard": "planted NaN and Inf",
    "numbers": "extreme numbers through neurad fit itself: light, size, place, unseen geometry, materials",
    "faults": "kills, full disks, a moved clock: nothing is lost, and runs continue alike",
    "features": "what a scene does not need is not built",
}
"""Name, which is also that of the module with its cases, and subject."""
