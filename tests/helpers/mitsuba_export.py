"""Built-in scenes as Mitsuba scenes, for tests that compare the two renderers."""

from neurad.studies.peer.export import to_mitsuba

__all__ = ["to_mitsuba"]
