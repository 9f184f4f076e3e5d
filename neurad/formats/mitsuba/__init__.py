"""Mitsuba 3: scene.xml."""
