"""`gnmreg coregister`: rounds of registration and model building over a dataset."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from workflows.cli import remote
from workflows.cli.options import Folder, JobOptions, ModelFile, RunOptions
from workflows.cli.remote import NO_SERVER, ServerOptions


@dataclass(frozen=True, kw_only=True)
class RoundOptions:
    """Rounds and their evaluation.

    Attributes:
        iterations: Maximum number of rounds. Fewer are computed if another one is not expected to improve the
            model.
        all_iterations: Compute all rounds, unless too many captures fail.
        model_recipe: Settings of model building. few_registrations: vertices weighted by area, covariance shrinkage
            towards the previous model chosen by cross-validation. true_meshes: for meshes in exact correspondence.
            Or the import path of a function that returns a ModelRecipe, as in my_module:my_recipe.
        held_out: Subjects to evaluate models on: a fraction such as 0.2, sampled with --seed, or a file with one
            subject folder's name on each line.
        components: Numbers of identity components to evaluate models with; the largest is compared between rounds.
        anatomy: Eyes, teeth, tongue and pupils of the first round's model. regenerate: from data of their own, as
            `gnmreg model anatomy` does. keep: as in the first model.
        gate: Registrations that the quality gate wants a person to look at. auto: models are built from them until a
            person rejects them. person: the run waits until all of them are decided; then `gnmreg retry`.
        gate_thresholds: Limits of the gate's rules, as `gnmreg gate calibrate` writes them. By default those of the
            farm, gate/thresholds.json in its folder, or built-in ones.
    """

    iterations: Annotated[int, arg(metavar="K")] = 3
    all_iterations: bool = False
    model_recipe: Annotated[str, arg(metavar="NAME|MODULE:FUNCTION")] = "few_registrations"
    held_out: Annotated[
        str | None,
        arg(metavar="FRACTION|FILE", help_behavior_hint="(default: neutrals tagged held_out, otherwise 0.2)"),
    ] = None
    components: Annotated[tuple[int, ...], arg(metavar="K", help_behavior_hint="(default: 5 10 20 40)")] = ()
    anatomy: Literal["regenerate", "keep"] = "regenerate"
    gate: Literal["auto", "person"] = "auto"
    gate_thresholds: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the farm's)")] = None


_FIT, _ROUNDS, _RUN = JobOptions(), RoundOptions(), RunOptions()


def coregister(
    dataset: Positional[Annotated[Path, arg(metavar="DATASET")]],
    /,
    model: ModelFile,
    out: Folder,
    rounds: RoundOptions = _ROUNDS,
    fit: JobOptions = _FIT,
    farm: RunOptions = _RUN,
    server: ServerOptions = NO_SERVER,
) -> int:
    """Build a head model from a dataset in rounds: register, build, evaluate.

    Every round registers the dataset with the previous round's model, builds the next model and evaluates it on
    held-out subjects.

    Args:
        dataset: A folder of subject folders, each with capture folders.
        model: The first head model, a GNM NPZ file with its landmark schemes beside it.
        out: Output folder. An earlier run of this command there is resumed.
        rounds: Rounds and their evaluation.
        fit: How captures are registered.
        farm: Where the jobs are executed.
        server: Submit to a service; DATASET, NPZ and DIR are places or names there.
    """
    if server.server is not None:
        return remote.coregister(server, str(dataset), str(model), str(out), rounds, fit)
    from coregister.anatomy.assemble import BUILDERS
    from coregister.stopping_rule import StoppingRule
    from registration.progress import console_progress
    from workflows.engine.process import migrate
    from workflows.farm.coregistration import coregister, submit_coregistration
    from workflows.farm.local import local_gpus
    from workflows.farm.plan import RoundSettings, make_plan
    from workflows.gate.decisions import DecisionLog
    from workflows.gate.rules import read_thresholds
    from workflows.records.round_files import PAGE

    folder = farm.farm_folder(out)
    log = DecisionLog.of_farm(folder)
    asked = farm.local or rounds.gate == "person" or log.exists()  # a farm's workers may not reach its folder
    settings = RoundSettings(
        model_recipe=rounds.model_recipe,
        held_out=_fraction_or_file(rounds.held_out),
        components=rounds.components or None,
        rule=StoppingRule(max_rounds=rounds.iterations, early_stopping=not rounds.all_iterations),
        anatomy=tuple(BUILDERS) if rounds.anatomy == "regenerate" else (),
        gate=rounds.gate,
        gate_thresholds=read_thresholds(rounds.gate_thresholds, folder),
        decisions=log.folder if asked else None,
    )
    plan = make_plan(dataset, model, out, fit.register_options(), settings)
    url = farm.url_for(folder)
    if not farm.local:
        print(f"{submit_coregistration(url, plan)} is in the queue; see gnmreg status")
        return 0
    migrate(url)
    gpus = local_gpus() if fit.variant == "cuda" else ()
    with console_progress() as progress:
        result = coregister(plan, url=url, folder=folder, workers=farm.workers, gpus=gpus, progress=progress)
    state = result.state
    for name, curve in state.generalization_mm.items():
        print(f"{name}, {state.at} components: generalization {curve[str(state.at)]:.3f} mm")
    print(f"{result.stopped or (state.verdict and state.verdict.reason)}\n{out / PAGE}")
    return 1 if result.stopped else 0


def _fraction_or_file(text: str | None) -> float | Path | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return Path(str(text))
