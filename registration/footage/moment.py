"""The landmarks of one moment: an image, a folder of images, or a capture."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from registration.capture.native import read_capture
from registration.capture.pixels import read_photograph
from registration.detect.detection import detect_landmarks
from registration.detect.landmark_folder import LandmarkFolder
from registration.detect.provider import LandmarkProvider
from registration.detect.providers import load_provider
from registration.detect.views import landmark_cache
from registration.errors import InputError
from registration.footage.faces import CachedFaces, choose, observed
from registration.footage.given import landmarks_of_views
from registration.footage.media import Kind
from registration.footage.observed import Footage, Sight, scheme_of
from registration.footage.options import FootageOptions
from registration.footage.searched import no_face
from registration.footage.stills import Still, read_stills
from registration.landmark_fit.observations import Observations, ViewCamera, of_capture
from registration.model.landmarks import LandmarkScheme
from registration.progress import Progress
from registration.storage.hashing import hash_capture, hash_file
from registration.types import Capture, View

_SAME_FOCAL = 0.01  # of EXIF's focal lengths, relative to the image


def read_moment(
    kind: Kind,
    source: Path,
    schemes: Mapping[str, LandmarkScheme],
    options: FootageOptions,
    out: Path,
    progress: Progress,
) -> Footage:
    """Read the views of one moment and their landmarks.

    Args:
        kind: of the input, no video.
        source: the input.
        schemes: of the model.
        options: of the fit.
        out: the folder that will be written; if no face is found, a picture of the search is written beside it.
        progress: receives steps and messages.

    Raises:
        InputError: something cannot be read, or shows no face.
    """
    if kind == "capture":
        return _of_capture(source, schemes, options, progress)
    return _of_stills(kind, source, read_stills(source), schemes, options, out, progress)


def _of_stills(
    kind: Kind,
    source: Path,
    stills: list[Still],
    schemes: Mapping[str, LandmarkScheme],
    options: FootageOptions,
    out: Path,
    progress: Progress,
) -> Footage:
    digests = {f"image {still.name}": hash_file(still.file) for still in stills}
    notes = [
        f"{still.name}: turned upright, by the orientation {still.orientation} of its EXIF data"
        for still in stills
        if still.orientation != 1
    ]
    if options.landmarks is not None:
        scheme, found = landmarks_of_views(options.landmarks, [still.name for still in stills], schemes)
        digests["landmarks"] = _digest(options.landmarks)
    else:
        provider = load_provider(options.detector)
        scheme = scheme_of(schemes, provider.scheme, provider.count, f"detector {options.detector}")
        found, chosen = _detected(stills, provider, options.face, source, out, progress)
        notes += chosen
        digests["detector"] = provider.version
    seen = [k for k, (points, _) in enumerate(found) if np.isfinite(points).any()]
    notes += [f"{still.name}: no landmarks; left out" for k, still in enumerate(stills) if k not in seen]
    kept = [stills[k] for k in seen]
    focal, guess, words = focal_lengths(kept, options.focal)
    views = tuple(
        ViewCamera(width_px=still.size_px[0], height_px=still.size_px[1], focal_px=px, group=still.group)
        for still, px in zip(kept, focal, strict=True)
    )
    shape = (1, len(kept), len(scheme.indices))
    observations = Observations(
        scheme=scheme,
        views=views,
        points_px=np.array([found[k][0] for k in seen]).reshape(*shape, 2),
        sigma_px=np.array([found[k][1] for k in seen]).reshape(shape),
    )
    sights = tuple(
        Sight(name=still.name, image=still.file.name, pixels=partial(_pixels, still), camera=None) for still in kept
    )
    return Footage(
        kind=kind,
        source=source,
        subject=source.stem if source.is_file() else source.resolve().name,
        expression="unknown",
        observations=observations,
        sights=sights,
        numbers=np.zeros(1, np.int64),
        times_s=np.zeros(1),
        detected=options.landmarks is None,
        focal_guess=guess,
        focal_source=words,
        notes=tuple(notes),
        digests=digests,
    )


def _pixels(still: Still) -> UInt8[np.ndarray, "H W 3"]:
    return still.pixels


def _detected(
    stills: Sequence[Still],
    provider: LandmarkProvider,
    number: int | None,
    source: Path,
    out: Path,
    progress: Progress,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[str]]:
    """Landmarks of the chosen face of each image, NaN where there is none, and notes."""
    faces, notes, found = CachedFaces(provider, landmark_cache()), [], []
    for k, still in enumerate(stills):
        seen = faces.search(still.pixels)
        if seen.faces:
            face, note = choose(seen.faces, number, still.name)
            notes += [note] if note else []
            notes += [] if seen.how == "upright" else [f"{still.name}: the face was found in {_WAYS[seen.how]}"]
            found.append(observed(face))
        else:
            found.append((np.full((provider.count, 2), np.nan), np.ones(provider.count)))
        progress.update(k + 1, len(stills), "detecting landmarks")
    if not any(np.isfinite(points).any() for points, _ in found):
        raise no_face([(still.name, still.pixels) for still in stills], source, out)
    return found, notes


_WAYS = {"turned": "the turned image", "tiles": "a part of the image, where it is small"}


def focal_lengths(stills: Sequence[Still], given: float | None) -> tuple[list[float | None], float | None, str]:
    """Return what is known of the images' focal lengths.

    Args:
        stills: of one moment.
        given: for all of them, px; None: none.

    Returns:
        Known focal lengths, px; a guess relative to the longer side, by EXIF, if they are unknown; and this in words.
    """
    if given is not None:
        return [given] * len(stills), None, "given"
    by_exif = [None if still.focal_px is None else still.focal_px / max(still.size_px) for still in stills]
    ratios = [ratio for ratio in by_exif if ratio is not None]
    if len(ratios) < len(stills) or not ratios:
        return [None] * len(stills), None, "estimated, without a hint"
    if max(ratios) / min(ratios) < 1 + _SAME_FOCAL:
        return [None] * len(stills), float(np.mean(ratios)), "estimated, about the one in the EXIF data"
    return [still.focal_px for still in stills], None, "of the EXIF data, which differ between the images"


def _of_capture(
    source: Path, schemes: Mapping[str, LandmarkScheme], options: FootageOptions, progress: Progress
) -> Footage:
    capture = read_capture(source)
    digests = {"capture": hash_capture(capture)}
    notes: list[str] = []
    own = [name for name in schemes if any(name in view.landmarks for view in capture.views)]
    if options.landmarks is not None:
        folder = LandmarkFolder(options.landmarks)
        detected = detect_landmarks(capture, folder, progress=progress)
        name, count = folder.scheme, folder.count
        digests["landmarks"] = folder.version
    elif own:
        name = max(own, key=lambda scheme: len(schemes[scheme].indices))
        count = next(len(view.landmarks[name]) for view in capture.views if name in view.landmarks)
        notes.append(f"the capture's own landmarks of scheme {name} are fitted")
        detected = None
    else:
        provider = load_provider(options.detector)
        name, count = provider.scheme, provider.count
        digests["detector"] = provider.version
        detected = detect_landmarks(capture, provider, progress=progress)
    scheme = scheme_of(schemes, name, count, source)
    if detected is not None:
        if not detected.usable:
            raise detected.error(capture)
        notes += detected.warnings
        capture = detected.into(capture)
    capture = _without_unseen(capture, scheme.name, notes)
    sights = tuple(
        Sight(
            name=view.name,
            image=view.image.relative_to(capture.root / "images").as_posix(),
            pixels=partial(_photograph, view),
            camera=replace(view.camera, distortion=()),
        )
        for view in capture.views
    )
    return Footage(
        kind="capture",
        source=source,
        subject=capture.subject,
        expression=capture.expression,
        observations=of_capture(capture, scheme),
        sights=sights,
        numbers=np.zeros(1, np.int64),
        times_s=np.zeros(1),
        detected=options.landmarks is None and not own,
        focal_source="of the capture",
        notes=tuple(notes),
        digests=digests,
    )


def _without_unseen(capture: Capture, scheme: str, notes: list[str]) -> Capture:
    views = tuple(view for view in capture.views if scheme in view.landmarks)
    if not views:
        raise InputError(
            "No view has landmarks", where=capture.root, expected=f"landmarks of scheme {scheme}", got="none"
        )
    missing = [view.name for view in capture.views if scheme not in view.landmarks]
    if missing:
        notes.append(f"without landmarks, left out: {', '.join(missing)}")
    return replace(capture, views=views)


def _photograph(view: View) -> UInt8[np.ndarray, "H W 3"]:
    return read_photograph(view)[0]


def _digest(path: Path) -> str:
    if path.is_file():
        return hash_file(path)
    return " ".join(hash_file(file) for file in sorted(path.glob("*.json")))
