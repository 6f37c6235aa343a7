"""Projects of COLMAP: a model, the images that it names, and masks and a mesh beside them.

Poses are world to camera in OpenCV's axes, the centre of pixel (0, 0) is at (0.5, 0.5), the scale of the world is
arbitrary unless the project was georeferenced. https://colmap.github.io/format.html
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from registration.capture.colmap import PosedImage, read_images
from registration.capture.dense_maps import COLMAP_SUFFIXES
from registration.errors import InputError
from registration.formats.colmap_lenses import lens_of
from registration.formats.source import Format, ReadOptions, SourceCapture, SourceView

# Where the model of a project lies: as the mapper and the GUI write it, undistorted, or as other programs keep it.
_MODELS = ("", "sparse", "sparse/0", "dense/sparse", "dense/0/sparse", "colmap/sparse/0", "colmap/sparse")
_IMAGES = ("images", "image", "imgs", "rgb", "input", "photos", "frames", "undistorted", "")
_MASKS = ("masks", "mask", "colmap_masks")
_SCANS = ("meshed-poisson.ply", "meshed-delaunay.ply", "fused.ply")
_PARTS = ("sparse", "dense", "colmap", "distorted", "text")  # folders inside a project, and numbers
_NEEDED = ("cameras", "images")


def _is_model(folder: Path) -> bool:
    return any(all((folder / f"{name}.{kind}").is_file() for name in _NEEDED) for kind in ("bin", "txt"))


def _detect(path: Path) -> bool:
    if not path.is_dir() or (path / "capture.toml").exists():
        return False
    return any(_is_model(path / place) for place in _MODELS)


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read a project: its folder, or that of its model.

    Raises:
        InputError: there is no model, or several; it cannot be read; an image of it is missing; or a lens is none.
    """
    model = _model_folder(path)
    images = read_images(model)
    if not images:
        raise _refuse("The COLMAP model has no images", model, "registered images", "none", "choose another model")
    roots = _roots(path, model)
    folder = _image_folder(roots, sorted(images))
    notes: list[str] = []
    views = tuple(_view(name, images[name], folder, roots) for name in sorted(images))
    if masked := sum(view.mask is not None for view in views):
        notes.append(f"masks of {masked} of {len(views)} views: white counts as the subject")
    scan = next((file for root in roots for name in _SCANS if (file := root / name).is_file()), None)
    if scan is not None:
        notes.append(f"{scan.name} was taken as the scan: it should show the subject without its surroundings")
    if (path / "dense").is_dir() and model.is_relative_to(path / "sparse"):
        notes.append("the original images were taken; import the folder dense for the undistorted ones")
    return SourceCapture(
        format=FORMAT.name,
        root=path,
        subject=options.subject or _project_name(path),
        expression=options.expression or "neutral",
        views=views,
        unit_m=None,
        scan=scan,
        notes=tuple(notes),
    )


def _project_name(path: Path) -> str:
    """The name of the first folder, upwards, that is no usual part of a project."""
    folders = [path.resolve(), *path.resolve().parents]
    return next(folder.name for folder in folders if folder.name not in _PARTS and not folder.name.isdecimal())


def _model_folder(path: Path) -> Path:
    found = [path / place for place in _MODELS if _is_model(path / place)]
    if not found:
        listed = ", ".join(place or "the folder itself" for place in _MODELS)
        raise _refuse(
            "There is no COLMAP model",
            path,
            f"cameras and images, as .bin or .txt, in {listed}",
            "none",
            "name the folder that holds them",
        )
    siblings = sorted(folder for folder in (path / "sparse").glob("*") if folder.is_dir() and _is_model(folder))
    if found[0] == path / "sparse/0" and len(siblings) > 1:
        names = ", ".join(folder.name for folder in siblings)
        fix = f"name the one to import, such as {siblings[0]}"
        raise _refuse("There are several COLMAP models", path / "sparse", "one model", names, fix)
    return found[0]


def _roots(path: Path, model: Path) -> list[Path]:
    """Folders in which images, masks and meshes may lie: from the model's folder upwards to the project's."""
    start, folders = model.absolute(), []
    top = path.absolute()
    for folder in (start, *start.parents):
        folders.append(folder)
        inner = folder.name in _PARTS or folder.name.isdecimal()
        if not inner and (folder == top or not folder.is_relative_to(top)):
            break
    named = [folder for folder in folders if folder.name != "sparse" and not folder.name.isdecimal()]
    if start == top and top.name == (named or [top])[0].name:  # a folder with the model alone
        named = [*named, top.parent]
    return named or folders[-1:]


def _image_folder(roots: Sequence[Path], names: Sequence[str]) -> Path:
    """The folder in which the images are, or most of them. Raises InputError."""
    usable = [name for name in names if PurePosixPath(name).suffix and not PurePosixPath(name).is_absolute()]
    counts: dict[Path, int] = {}
    for folder in (root / place for root in roots for place in _IMAGES):
        if folder.is_dir() and (count := sum((folder / name).is_file() for name in usable)):
            counts.setdefault(folder, count)
    best = max(counts, key=lambda folder: counts[folder], default=None)
    if best is not None and counts[best] == len(names):
        return best
    if best is None:
        missing, got = names[0], f"none of the {len(names)} images is there"
    else:
        missing = next(name for name in names if not (best / name).is_file())
        got = f"{counts[best]} of {len(names)} images are in {best}"
    looked = ", ".join(place or "." for place in _IMAGES)
    raise _refuse(
        "An image of the COLMAP model is missing",
        roots[0],
        f"{missing} in one of the folders {looked}",
        got,
        "put the images there; or remove those that are gone from the model, with COLMAP's image_deleter",
    )


def _view(name: str, image: PosedImage, folder: Path, roots: Sequence[Path]) -> SourceView:
    intrinsics, distortion = lens_of(image)
    return SourceView(
        name=PurePosixPath(name).with_suffix("").as_posix(),
        image=folder / name,
        width_px=image.camera.width_px,
        height_px=image.camera.height_px,
        intrinsics=np.array(intrinsics),
        T_cam_world=image.T_cam_world,
        distortion=distortion,
        mask=_mask(roots, name),
        normals=_dense_map(folder, "normal_maps", name),
        depth=_dense_map(folder, "depth_maps", name),
    )


def _mask(roots: Sequence[Path], name: str) -> Path | None:
    """COLMAP's name of a mask is the image's and .png; other programs replace the suffix."""
    names = (f"{name}.png", PurePosixPath(name).with_suffix(".png").as_posix(), name)
    places = [root / folder / mask for root in roots for folder in _MASKS for mask in names]
    return next((file for file in places if file.is_file()), None)


def _dense_map(images: Path, kind: str, name: str) -> Path | None:
    """A map of the dense reconstruction in `stereo`, beside the undistorted images; of both kinds the filtered one."""
    places = [images.parent / "stereo" / kind / f"{name}{suffix}" for suffix in COLMAP_SUFFIXES]
    return next((file for file in places if file.is_file()), None)


def _refuse(what: str, where: object, expected: object, got: object, fix: str) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)


FORMAT = Format(
    name="colmap",
    title="COLMAP project",
    files="sparse/ with cameras and images as .bin or .txt",
    detect=_detect,
    read=read,
)
