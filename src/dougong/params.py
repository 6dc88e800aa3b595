"""Base class of every parameter set: one object in Python, TOML, CLI and provenance."""

from pydantic import BaseModel, ConfigDict


class Parameters(BaseModel):
    """Frozen, refuses unknown names, prints and serialises itself.

    Units stand in the field names. A field's docstring is its help text.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
