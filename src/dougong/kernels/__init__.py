"""Compiled loops. Checked arrays in, `out` filled; nothing above this room is imported."""
