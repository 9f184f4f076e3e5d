"""Built-in scenes as Mitsuba scenes, for tests that compare the two renderers."""

from neurad.export.mitsuba import to_mitsuba

__all__ = ["to_mitsuba"]
