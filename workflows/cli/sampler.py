"""`gnmreg sampler train` and `gnmreg sample`: heads by named categories."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.errors import InputError
from workflows.cli.options import NOT_SET, Folder, ModelFile, OptionalFolder, Seed

Weights = Annotated[str | None, arg(metavar="NAME[=W],...", help_behavior_hint=NOT_SET)]


@dataclass(frozen=True, kw_only=True)
class Categories:
    """The categories of the heads that are drawn.

    Attributes:
        gender: One category, or a blend of several; by default a random one of each head. Weights are scaled to the
            sum 1.
        ethnicity: As the gender.
        expression: As the gender; by default neutral.
        factor: Categories of other factors that the sampler was trained with.
    """

    gender: Weights = None
    ethnicity: Weights = None
    expression: Weights = None
    factor: Annotated[tuple[str, ...], arg(metavar="FACTOR:NAME[=W],...", help_behavior_hint=NOT_SET)] = ()

    def by_factor(self) -> dict[str, str]:
        """Return factor -> its categories and weights, as they were given. Raises InputError."""
        given = {"gender": self.gender, "ethnicity": self.ethnicity, "expression": self.expression}
        wanted = {name: text for name, text in given.items() if text is not None}
        for entry in self.factor:
            name, colon, text = entry.partition(":")
            if not colon or name in wanted:
                fix, expected = "give each factor once", "FACTOR:NAME or FACTOR:NAME=WEIGHT,..."
                raise InputError("A factor cannot be read", where="--factor", expected=expected, got=entry, fix=fix)
            wanted[name] = text
        return wanted


def train(
    source: Positional[Annotated[Path, arg(metavar="RUN|NPZ")]],
    /,
    model: ModelFile,
    out: Folder,
    captures: OptionalFolder = None,
    factors: Annotated[tuple[str, ...], arg(metavar="TAG")] = ("gender", "ethnicity"),
    steps: Annotated[int, arg(metavar="N")] = 8000,
    kl_weight: Annotated[float, arg(metavar="W")] = 0.05,
    seed: Seed = 0,
) -> int:
    """Train a semantic sampler of identities and expressions from registrations.

    Two conditional autoencoders: one of identities, by tags of the subjects, and one of expressions, by their labels.

    Args:
        source: A folder of subject folders that `gnmreg subject` wrote, or an NPZ file of coefficients.
        model: The head model of the registrations, a GNM NPZ file.
        out: The folder to write; one that this command wrote before is replaced.
        captures: The folder of the subjects' captures, which hold the tags.
        factors: Tags that are the identity's factors; none: only expressions.
        steps: Steps of each training.
        kl_weight: Weight of the KL divergence after the warm-up.
        seed: Seed of everything random.
    """
    from coregister.sampler.loss import KLSchedule
    from coregister.sampler.training import TrainingSettings
    from registration.progress import console_progress
    from workflows.steps.sampler import SamplerInput, train_sampler, training_lines

    settings = TrainingSettings(steps=steps, schedule=KLSchedule(weight=kl_weight), seed=seed)
    given = SamplerInput(source=source, captures=captures, factors=factors)
    with console_progress() as progress:
        record = train_sampler(given, model, out, settings, progress)
    print("\n".join((*training_lines(record), str(out))))
    return 1 if any(part.metrics.status != "trained" for part in record.parts.values()) else 0


def sample(
    sampler: Annotated[Path, arg(metavar="SAMPLER")],
    model: ModelFile,
    out: Folder,
    categories: Categories = Categories(),
    count: Annotated[int, arg(metavar="N")] = 12,
    seed: Seed = 0,
) -> int:
    """Draw heads of named categories.

    Writes coefficients, meshes and a contact sheet.
    Heads whose parts penetrate one another are drawn again.

    Args:
        sampler: A folder that `gnmreg sampler train` wrote; or Google's decoders, one HDF5 file or the folder of both.
        model: The head model, a GNM NPZ file.
        out: The folder to write; one that this command wrote before is replaced.
        categories: Of the heads.
        count: Number of heads.
        seed: Seed of everything random.
    """
    from coregister.sampler.sampling import SampleSettings
    from registration.progress import console_progress
    from workflows.steps.sampler import sample as draw

    settings = SampleSettings(wanted=categories.by_factor(), count=count, seed=seed)
    with console_progress() as progress:
        drawn = draw(sampler, model, out, settings, progress)
    for remark in drawn.remarks:
        print(remark)
    left = sum(head.penetrates for head in drawn.heads)
    print(
        f"{len(drawn.heads)} heads; {drawn.first_penetrating} of them penetrated at first, and were drawn again "
        f"{drawn.redrawn} times; {left} still penetrate"
    )
    print(out / "contact_sheet.png")
    return 0
