"""``python -m benchmarks.rooms``: model the built-in kitchens and write the files that ship."""

from benchmarks.rooms import ROOMS
from benchmarks.rooms.furnished import write_room
from neurad.scene.builtin.plain import DATA

for name, (model, film) in ROOMS.items():
    write_room(model(), film, DATA / name / "room.npz")
