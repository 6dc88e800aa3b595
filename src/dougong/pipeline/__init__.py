"""The main job: filter, register, merge, with provenance."""
