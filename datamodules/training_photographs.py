"""The photographs of a scene's training views: in memory, or read from disk as their turn comes."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from datamodules.fireflies import Fireflies, find_fireflies, spread_fireflies
from datamodules.image_cache import blurred, checksum, dataset_stats
from datamodules.value_limits import ValueLimits
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import DatasetStats, PixelBatch
from neurad.core.scene_records import View
from neurad.images.photographs import kept_pixels, may_have_alpha, read_view
from neurad.images.picture_notes import say_pictures
from neurad.runtime.progress import counted, say
from neurad.runtime.reading import listed, read_bytes
from neurad.scene.description import Scene


class TrainingPhotographs(PhotoSource):
    """What the photographs of a scene's training views hold, whole and pixel by pixel. Held-out photographs and
    ground-truth maps are never opened here.

    Attributes:
        resident: photographs in memory at once; None keeps all there.
        seed: of the sample of pixels that statistics keep.
    """

    resident: int | None = None
    seed: int = 0
    _spread: tuple[Fireflies, Sequence[Tensor]] | None = None
    _stats: DatasetStats | None = None

    @property
    @abstractmethod
    def scene(self) -> Scene:
        """The scene whose training views these are."""

    @property
    def streams(self) -> bool:
        """Whether only some of the photographs are in memory at a time."""
        return self.resident is not None and self.resident < len(self.scene.train)

    @cached_property
    def _sizes(self) -> list[tuple[int, int]]:
        """Width and height in pixels of every training photograph."""
        return [(view.camera.width, view.camera.height) for view in self.scene.train]

    def _count(self, index: int) -> int:
        """Pixels of a training photograph."""
        return self._sizes[index][0] * self._sizes[index][1]

    @cached_property
    def _pixels(self) -> Tensor:
        """Training photographs [views, pixels, 3 or 4]: of each its own ones, row by row, then 0 up to as many as the
        largest has.
        """
        views = self.scene.train
        if not views:
            raise InputError(f"scene {self.scene.name}: it has no training photographs")
        most, pixels = max(w * h for w, h in self._sizes), torch.empty(0)
        for index, view in enumerate(counted(views, "reading", len(views), "photographs")):
            image = self._read(view)
            if index == 0 or image.shape[1] > pixels.shape[2]:
                before, pixels = pixels[:index], image.new_zeros(len(views), most, image.shape[1])
                for place, other in enumerate(before):
                    pixels[place, : self._count(place)] = _with_alpha(other[: self._count(place)])
            pixels[index, : len(image)] = image if image.shape[1] == pixels.shape[2] else _with_alpha(image)
        return pixels

    def ignored(self) -> Tensor | None:
        """Pixels that masks leave out, or that files do not have [views, pixels], bool; None where there are none.

        Raises:
            InputError: as :func:`neurad.images.photographs.kept_pixels`.
        """
        views = self.scene.train
        kept = [kept_pixels(view) for view in views]
        if all(part is None for part in kept):
            return None
        left_out = torch.zeros(len(views), max(w * h for w, h in self._sizes), dtype=torch.bool)
        for index, part in enumerate(kept):
            if part is not None:
                left_out[index, : self._count(index)] = ~torch.from_numpy(part).view(-1)
        return left_out

    @staticmethod
    def _read(view: View) -> Tensor:
        """One photograph [h * w, 3], or [h * w, 4] where its alpha is below 1 somewhere."""
        if view.image is None:
            raise InputError(f"training view {view.name}: it has no photograph")
        image = read_view(view)
        return torch.from_numpy(image).view(-1, image.shape[2])

    @cached_property
    def photographs(self) -> Tensor:
        """Linear colours of the training views, premultiplied by alpha [views, pixels, 3]; 0 behind the last pixel of a
        view that is smaller than others.
        """
        return self._pixels[..., :3].contiguous()

    @cached_property
    def alpha(self) -> Tensor | None:
        """Coverage of the training views [views, pixels], or None if it is 1 everywhere."""
        return self._pixels[..., 3].contiguous() if self.has_alpha else None

    @cached_property
    def _blurred(self) -> Tensor:
        """Means of the photographs over 5 x 5 pixels [views, pixels, 3]."""
        if len(set(self._sizes)) == 1:
            return blurred(self.photographs, self.alpha, self._sizes[0][0])
        means = torch.zeros_like(self.photographs)
        for index, (width, _) in enumerate(self._sizes):
            here = slice(index, index + 1), slice(self._count(index))
            alpha = None if self.alpha is None else self.alpha[here]
            means[here] = blurred(self.photographs[here], alpha, width)
        return means

    @cached_property
    def has_alpha(self) -> bool:
        """Whether alpha is below 1 in some pixel of the photographs; False in a scene without photographs."""
        views = [view for view in self.scene.train if view.image is not None]
        if "_pixels" in self.__dict__ or (views and not self.streams):
            return self._pixels.shape[-1] == 4
        return any(may_have_alpha(view) and self._read(view).shape[-1] == 4 for view in views)

    def dataset_stats(self, left_out: Tensor | None = None) -> DatasetStats:
        """Statistics of all training photographs; streamed ones are read from disk once, one after the other.

        Raises:
            InputError: a photograph is missing or wrong, or alpha is 0 in all of them.
        """
        read = self._streamed_spread if self.streams else self._resident
        found = dataset_stats(read, len(self.scene.train), left_out, self.seed)
        if self._spread is not None and self._stats is not None:  # checksums are those of the files
            found = replace(found, checksums=self._stats.checksums)
        if self._limits is not None:
            found = replace(found, sample=self._limits.marked(found.sample))
            if self._stats is None:
                self._limits.check(found.sample, self.scene.train, self.scene.name)
        if self._stats is None:
            say_pictures()
            if found.covered:
                names = [self.scene.train[index].name for index in found.covered]
                say(
                    f"alpha is 1 everywhere in {len(names)} of {len(self._sizes)} photographs "
                    f"({listed(names)}) and below it in others: where no surface is, all are taken to be black, and to "
                    "show no environment"
                )
        self._stats = found
        if not self._stats.foreground:
            raise InputError(f"scene {self.scene.name}: alpha is 0 in every training photograph")
        return self._stats

    @cached_property
    def _limits(self) -> ValueLimits | None:
        """Ceilings and rounding of the photographs; None where none has either."""
        return ValueLimits.of(self.scene.train)

    def clipped(self, view: Tensor, pixel: Tensor) -> Tensor | None:
        """Whether values of pixels [n] of views [n] are at their photograph's ceiling [n, 3]; None if none has one."""
        if self._limits is None:
            return None
        color = self.colors(view, pixel)
        return self._limits.marked(PixelBatch(view, pixel, color, torch.ones(len(view)), 0)).clipped

    def colors(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Photographed radiance [n, 3] of pixels [n] of views [n]; streamed photographs are read from disk for it."""
        read = self._streamed if self.streams else self._resident
        found = torch.empty(len(view), 3)
        for index in sorted(set(view.tolist())):
            mine = (view == index).nonzero().squeeze(-1)
            found[mine] = read(index)[pixel[mine], :3]
        return found

    def spread_fireflies(self, left_out: Tensor, beyond: Callable[[], Tensor] | None = None) -> float:
        """As :class:`~neurad.core.protocols.PhotoSource` says; streamed photographs are spread as they are read, and a
        few of them are measured.
        """
        if self._spread is None:
            read, widths = self._streamed if self.streams else self._resident, [width for width, _ in self._sizes]
            shown = [mask[: self._count(index)] for index, mask in enumerate(left_out)]
            found, masks = find_fireflies(read, shown, widths, beyond)
            self._spread = found, masks
            if found.spread and not self.streams:
                spread = torch.zeros_like(self._pixels)
                for index, (mask, width) in enumerate(zip(masks, widths, strict=True)):
                    spread[index, : len(mask)] = spread_fireflies(self._resident(index), mask, width)
                self._pixels = spread
                self.__dict__.pop("photographs", None)  # made anew from what they are now
                self.__dict__.pop("_blurred", None)
        found = self._spread[0]
        return found.light if found.spread else 0.0

    def _resident(self, index: int) -> Tensor:
        """One training photograph [h * w, 3 or 4] of those in memory."""
        return self._pixels[index, : self._count(index)]

    def _streamed(self, index: int) -> Tensor:
        """One training photograph [h * w, 3 or 4] from disk; also called from the thread that reads ahead."""
        view = self.scene.train[index]
        if view.image is not None:
            # OpenEXR holds Python's lock while it waits for the disk; this does not.
            read_bytes(view.image)
        image = self._read(view)
        if self.has_alpha and image.shape[1] == 3:
            image = _with_alpha(image)
        if self._stats is not None and checksum(image) != self._stats.checksums[index]:
            raise InputError(f"{view.image}: it has changed since the run began; put it back and continue the run")
        return image

    def _streamed_spread(self, index: int) -> Tensor:
        """The photograph of a training view as it is streamed, its fireflies spread where they are to be."""
        image = self._streamed(index)
        if self._spread is None or not self._spread[0].spread:
            return image
        return spread_fireflies(image, self._spread[1][index], self._sizes[index][0])


def _with_alpha(pixels: Tensor) -> Tensor:
    """Photographs [..., 3] with an alpha of 1 [..., 4]."""
    return torch.cat((pixels, torch.ones_like(pixels[..., :1])), -1)
