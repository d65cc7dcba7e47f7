"""The P4Runtime server: requests, entities, streams."""
