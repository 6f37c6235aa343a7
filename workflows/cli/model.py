"""`gnmreg model ...`: head models described, evaluated, built from public data, found and downloaded."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from workflows.cli.options import (
    FaceSettings,
    Folder,
    ModelFile,
    OptionalFile,
    OptionalFolder,
    OptionalImage,
    OptionalModel,
    Seed,
)

Part = Literal["eyes", "teeth", "tongue", "pupils"]


def info(file: Positional[Annotated[Path, arg(metavar="FILE")]], /, out: OptionalImage = None) -> int:
    """Describe a model file: origin, digests, dimensions, parts, regions, anatomy.

    Args:
        file: The head model, a GNM NPZ file; a GNMW file for the web; or a model of others, such as FLAME's
            (docs/other_models.md).
        out: Image of the model to draw; of a GNM NPZ file only.
    """
    from registration.anatomy.panels import anatomy_panels
    from registration.errors import InputError
    from registration.linear_models import describe
    from registration.linear_models.registry import other_format
    from registration.model import gnmw, info

    web = file.suffix.lower() == gnmw.SUFFIX
    other = None if web else other_format(file)
    if not web and other is None:
        info.describe(file, picture=out, panels=anatomy_panels)
    elif out is not None:
        what = "A GNMW file" if other is None else "A model of another format"
        fix = "omit --out, or give the model's NPZ file"
        raise InputError(f"{what} cannot be drawn", where=file, expected="a GNM NPZ file", got=file.name, fix=fix)
    elif web:
        info.describe_web(file)
    else:
        describe.describe(file)
    return 0


def export(
    model: Positional[Annotated[Path, arg(metavar="NPZ")]],
    out: Positional[Annotated[Path, arg(metavar="FILE")]],
    /,
    extra_fields: bool = False,
) -> int:
    """Write a model for other programs: as GNMW for the web, or as official NPZ.

    An NPZ file has exactly the fields that Google's loader accepts. A GNMW file holds the template, its triangles and
    both bases with 8 bits a value; what that costs is printed.

    Args:
        model: The head model, a GNM NPZ file.
        out: The file to write; its suffix, .gnmw or .npz, is the format.
        extra_fields: Write fields outside the official ones into the same NPZ file, instead of a second one beside
            it. Google's loader refuses such a file.
    """
    from registration.model.export import export_model

    for line in export_model(model, out, extra_fields=extra_fields):
        print(line)
    return 0


def evaluate(
    models: Positional[Annotated[tuple[Path, ...], arg(metavar="MODEL", help_behavior_hint="(required)")]],
    /,
    held_out: Annotated[Path, arg(metavar="RUN|NPZ")],
    out: Folder,
    captures: OptionalFolder = None,
    components: Annotated[tuple[int, ...], arg(metavar="K")] = (5, 10, 20, 40),
    samples: Annotated[int, arg(metavar="N")] = 200,
    seed: Seed = 0,
    force: bool = False,
) -> int:
    """Evaluate head models on held-out subjects and compare them with the first.

    Args:
        models: The head models, GNM NPZ files of one topology.
        held_out: A folder of subject folders that `gnmreg subject` wrote, or an NPZ file of meshes.
        out: The folder to write; one that this command wrote before is replaced.
        captures: The folder of the subjects' captures: adds scans, categories and tags.
        components: Numbers of components to evaluate, besides all of a model's.
        samples: Random heads of each model, for specificity; 0: no specificity.
        seed: Seed of the random heads.
        force: Evaluate again although the folder holds the result of the same input.
    """
    from coregister.evaluate.evaluation import EvaluationSettings
    from registration.progress import console_progress
    from workflows.steps.evaluate import PAGE, evaluate_models, lines

    settings = EvaluationSettings(components=components, samples=samples, seed=seed)
    with console_progress() as progress:
        manifest = evaluate_models(
            models, held_out=held_out, out=out, captures=captures, settings=settings, force=force, progress=progress
        )
    print("\n".join((*lines(manifest), str(out / PAGE))))
    return 0


def compare(
    models: Positional[Annotated[tuple[Path, ...], arg(metavar="MODEL", help_behavior_hint="(required)")]],
    /,
    samples: Annotated[Path, arg(metavar="RUN|NPZ")],
    out: Folder,
    captures: OptionalFolder = None,
    maps: Annotated[tuple[Path, ...], arg(metavar="MAP", help_behavior_hint="(optional)")] = (),
    without_jaw: Annotated[tuple[Path, ...], arg(metavar="MODEL", help_behavior_hint="(optional)")] = (),
    settings: FaceSettings = FaceSettings(),  # noqa: B008
    jobs: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Compare models of any topology on registered scans, as the paper does.

    Models are fitted to each registered mesh, then to the scan, without regularization. A folder holds the page, all
    numbers as CSV and a result per scan; the same command resumes.

    Args:
        models: Head models, of any format that can be read; the first is a GNM file of the registrations' topology.
        samples: A folder of subject folders that `gnmreg subject` wrote, or an NPZ file of registered scans.
        out: The folder to write; results in it are kept where their input is the same.
        captures: The folder of the subjects' captures, which hold the scans; with a folder of registrations.
        maps: Maps from the first model's topology to those of the others, of `gnmreg model map`.
        without_jaw: Further models, compared without their jaw joint: FLAME's file without the jaw, or FLAME's again.
        settings: How models are compared.
        jobs: Number of processes.
    """
    from registration.progress import console_progress
    from workflows.steps.compare import NUMBERS, PAGE, ComparisonInput, compare_models, lines

    given = ComparisonInput(models=models, samples=samples, captures=captures, maps=maps, without_jaw=without_jaw)
    with console_progress() as progress:
        comparison = compare_models(given, out=out, settings=settings.protocol(), jobs=jobs, progress=progress)
    print("\n".join((*lines(comparison), str(out / PAGE), str(out / NUMBERS))))
    return 0


def fetch(source: Annotated[Literal["http", "huggingface", "kaggle"], arg(metavar="SOURCE")] = "http") -> int:
    """Find or download Google's GNM head weights and print their path.

    The weights are (c) Google LLC, under the Apache License 2.0. Files on this machine are used first: in the cache
    folders of Google's loader (GNM_CACHE_DIR, XDG_CACHE_HOME/gnm/models, ~/.cache/gnm/models), of the programs of
    Hugging Face and Kaggle, and in our own. Otherwise 53 MB are downloaded, checked, and recorded with their digest.

    Args:
        source: Where to download from. http: Google's default address, whatever is newest there. huggingface: release
            3.0 there, checked by its sha256; HF_ENDPOINT names a mirror. kaggle: the copy on Kaggle.
    """
    from registration.model.fetch import fetch, sources
    from registration.progress import console_progress

    with console_progress() as progress:
        path = fetch(sources()[source], progress=progress)
    print(path)
    return 0


def bootstrap(out: OptionalModel = None) -> int:
    """Build the first model from MakeHuman's CC0 head and print its path.

    It is built once and kept in the cache.

    Args:
        out: Copy the model file here, with its landmark schemes beside it.
    """
    from coregister.first_model.build import bootstrap

    print(bootstrap(out))
    return 0


def cranium(
    model: Positional[Annotated[Path, arg(metavar="NPZ")]],
    /,
    out: OptionalFile = None,
    heads: OptionalFolder = None,
    count: Annotated[int, arg(metavar="N")] = 200,
    seed: Seed = 0,
) -> int:
    """Build the auxiliary model of whole heads that completes a cranium under hair.

    Registrations and builds with the head model find it beside the model's file.

    Args:
        model: The head model, a GNM NPZ file.
        out: The file to write; by default head_cranium.npz beside the model.
        heads: Folder of at least 30 whole heads in the model's topology, meshes or registrations. By default people
            of MakeHuman's CC0 population, carried to the model's topology if it is not the first model's.
        count: Number of MakeHuman's people.
        seed: Seed of MakeHuman's people.
    """
    from registration.progress import console_progress
    from workflows.steps.cranium_model import lines, make_cranium_model

    with console_progress() as progress:
        path, built = make_cranium_model(model, out, heads=heads, count=count, seed=seed, progress=progress)
    print("\n".join((*lines(built), str(path))))
    return 0


def anatomy(
    model: Positional[Annotated[Path, arg(metavar="MODEL")]],
    /,
    out: Annotated[Path, arg(metavar="NPZ")],
    parts: Annotated[tuple[Part, ...], arg(metavar="PART", help_behavior_hint="(default: all)")] = (),
    keep_eyes: bool = False,
    tongue_keypoints: Annotated[tuple[Path, ...], arg(metavar="FILE", help_behavior_hint="(default: none)")] = (),
    tongue_registrations: Annotated[Path | None, arg(metavar="RUN|NPZ")] = None,
    seed: Seed = 0,
) -> int:
    """Regenerate eyes, teeth, tongue and pupils of a model from data of their own.

    The written model has the layout head, eyes, teeth of the identity and left eye, right eye, lower face, tongue,
    pupil of the expression. The head's components, and those of the parts that are not named, are kept.

    Args:
        model: The head model, a GNM NPZ file.
        out: The model file to write, with its manifest and landmark schemes beside it.
        parts: The parts to regenerate.
        keep_eyes: Keep the shape of the template's eyes, instead of the mean of the sampled ones.
        tongue_keypoints: Recordings of points on the tongue, CSV or NPZ files.
        tongue_registrations: Registrations in whose open mouths the tongue is posed: a run, or an NPZ file of held-out
            subjects. Without them, expressions of the model.
        seed: Seed of everything random.
    """
    from coregister.anatomy.assemble import BUILDERS, AnatomySettings
    from coregister.anatomy.eyes import EyeSettings
    from registration.progress import console_progress
    from workflows.steps.anatomy import TongueFiles, write_anatomy

    settings = AnatomySettings(parts=parts or tuple(BUILDERS), seed=seed, eyes=EyeSettings(mean_template=not keep_eyes))
    with console_progress() as progress:
        files = TongueFiles(keypoints=tongue_keypoints, registrations=tongue_registrations)
        lines = write_anatomy(model, out, settings, progress, files)
    print("\n".join((*lines, str(out))))
    return 0


def place(
    model: Positional[Annotated[Path, arg(metavar="MODEL")]],
    /,
    out: Annotated[Path, arg(metavar="NPZ")],
) -> int:
    """Place teeth and tongue of a model by the motion of lips and chin.

    For a model whose teeth and tongue came from elsewhere. In the identity they move with the mean of the inner lips,
    in expressions the lower teeth and the tongue with the rigid motion of lower lip and chin. Nothing else changes.

    Args:
        model: The head model, a GNM NPZ file.
        out: The model file to write, with its manifest and landmark schemes beside it.
    """
    from workflows.steps.anatomy import write_placed

    print("\n".join((*write_placed(model, out), str(out))))
    return 0


def landmarks(
    model: ModelFile,
    provider: Annotated[str, arg(metavar="NAME")] = "face478",
    out: OptionalFile = None,
    picture: OptionalImage = None,
    identities: Annotated[int, arg(metavar="N")] = 24,
    seed: Seed = 0,
) -> int:
    """Map a detector's landmarks to points of a model, with a spread of each.

    People of the model are rendered with expressions from several sides, and the detector is run on the pictures. The
    map has the points of the surface that its landmarks mark, and how far they stray from them on people that were
    left out. Lids, lips, irises and both sides are checked. Takes minutes.

    Args:
        model: The head model, a GNM NPZ file.
        provider: The landmark provider: face478, or the import path of another one, as module:function.
        out: The file to write; by default head_sparse_SCHEME.txt beside the model, where registrations find it.
        picture: Picture of the points on the model, coloured by their spread.
        identities: Number of rendered people.
        seed: Seed of people, expressions, cameras and light.
    """
    from registration.detect.map_renders import RenderSettings
    from registration.progress import console_progress
    from workflows.steps.landmark_map import make_landmark_map

    settings = RenderSettings(identities=identities, seed=seed)
    with console_progress() as progress:
        path, lines = make_landmark_map(model, provider, out, settings, picture, progress)
    print("\n".join((*lines, str(path))))
    return 0


def map_(
    source: Positional[Annotated[Path, arg(metavar="A")]],
    target: Positional[Annotated[Path, arg(metavar="B")]],
    /,
    out: Annotated[Path, arg(metavar="MAP")],
    picture: OptionalImage = None,
) -> int:
    """Map the topology of one head to that of another.

    B is bent onto A. The map says of every vertex of B where on A's surface it lies, and back, so that vertices,
    landmarks, groups and bases can be carried over. It is accepted if the bent vertices are nearer than 0.02 mm in the
    mean, no face is flipped, and vertices that are carried there and back return to 0.2 mm. A refused map is written
    with its reasons and a picture; the exit status is then 1.

    Args:
        source: A head model, or a mesh (OBJ, PLY, GLB; metres) with landmarks beside it, as head_sparse_NAME.txt.
        target: Another one; a mesh may have any unit and frame.
        out: The map to write, an NPZ file.
        picture: Picture of the distances; by default one beside a refused map.
    """
    from registration.progress import console_progress
    from workflows.steps.topology_map import lines, make_topology_map

    with console_progress() as progress:
        mapped = make_topology_map(source, target, out, picture, progress)
    print("\n".join((*lines(mapped), str(out))))
    return 0 if mapped.accepted else 1
