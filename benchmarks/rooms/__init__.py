"""The scripts that model the built-in kitchens; what they make ships as ``neurad/scene/builtin/data/NAME/room.npz``."""

from collections.abc import Callable

from benchmarks.rooms import kitchen, patterned_kitchen
from benchmarks.rooms.furnished import Film
from neurad.scene.description import Scene

ROOMS: dict[str, tuple[Callable[[], Scene], Film]] = {
    "kitchen": (kitchen.model_kitchen, kitchen.FILM),
    "patterns": (patterned_kitchen.model_patterns, patterned_kitchen.FILM),
}
"""The function that models a room, and its cameras, by the room's name."""
