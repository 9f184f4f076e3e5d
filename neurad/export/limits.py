"""Ranges of what an export may be asked for; imports nothing heavy, as the help of the verb reads them."""

from typing import Annotated

from neurad.core.ranges import Range

Texels = Annotated[int, Range(4096, 1 << 34)]
"""Texels of all textures together; a room has dozens of meshes, and none gets less than 8 x 8."""
Side = Annotated[int, Range(8, 8192)]
"""Texels along a side of one texture."""
