"""What may be chosen about an export."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """How registrations and models are written in the formats of other programs.

    Attributes:
        frame: head: the mesh is moved rigidly to where the model's own head is, +Y up, +Z out of the face. world: as
            captured.
        accept_failed: Export failed registrations too.
    """

    frame: Literal["head", "world"] = "head"
    accept_failed: bool = False
