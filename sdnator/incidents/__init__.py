"""Incidents for people and programs: from the archive, as rows, as text, as JSON."""
