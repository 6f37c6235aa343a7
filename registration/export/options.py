"""What may be chosen about an export."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from registration.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """How registrations and models are written in the formats of other programs.

    Attributes:
        frame: head: the mesh is moved rigidly to where the model's own head is, +Y up, +Z out of the face. world: as
            captured.
        failed: What to do with registrations that failed or are missing: refuse the export, skip them, or export those
            that failed all the same.
        fill: Fill the texels that no camera saw: from --fill-from, the other side of the head, their surroundings. The
            image OUT_unseen.png beside OUT is white where they were.
        fill_from: Fill with the texels that were seen in these registrations of the same subject, the first where
            several have them; implies --fill.
        arkit: Add ARKit's 52 blend shapes to a model or to a registered neutral, solved in the model's expression
            basis; those that it cannot express are named and left out.
        sequence: Write the expressions of a subject as the frames of a sequence, in the natural order of their names.
            A folder of registrations is a sequence anyway.
        subject: The subject to export from a stabilized set of several.
        fps: Frames per second of a sequence.
    """

    frame: Literal["head", "world"] = "head"
    failed: Literal["refuse", "skip", "export"] = "refuse"
    fill: bool = False
    fill_from: Annotated[tuple[Path, ...], arg(metavar="REG", help_behavior_hint="(optional)")] = ()
    arkit: bool = False
    sequence: bool = False
    subject: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the only one)")] = None
    fps: Annotated[float, arg(metavar="F")] = 24.0

    @property
    def fills(self) -> bool:
        """Whether texels are filled."""
        return self.fill or bool(self.fill_from)

    def __post_init__(self) -> None:
        if not 0 < self.fps <= 1000:
            fix = "choose another rate"
            raise InputError(
                "The frame rate is out of range",
                where="--fps",
                expected="a number above 0, at most 1000",
                got=self.fps,
                fix=fix,
            )
