"""How the pipeline tells what it is doing, without knowing who listens."""

from typing import Protocol


class Progress(Protocol):
    """Listens to a job. The command line shows bars or lines; a library call hears nothing."""

    def stage(self, text: str) -> None:
        """Begin a stage; the one before it is over."""

    def fraction(self, done: float) -> None:
        """Say how much of the stage is done, 0..1."""

    def note(self, text: str) -> None:
        """Say something the user should read, counted and in words."""


class Silent:
    """Hears everything, says nothing."""

    def stage(self, text: str) -> None:
        """Ignore the stage."""

    def fraction(self, done: float) -> None:
        """Ignore the share done."""

    def note(self, text: str) -> None:
        """Ignore the note."""
