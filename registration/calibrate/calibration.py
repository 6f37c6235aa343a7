"""Cameras of photographs of one moment, without any calibration: poses, focal lengths, and metres by the head model."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.calibrate.assembly import Assembled, Evidence, assemble, match_pairs
from registration.calibrate.bundle import Observations
from registration.calibrate.features import (
    MIN_MATCHES,
    Features,
    Matches,
    find_features,
    joined,
    match,
    mirrored,
    tracks,
)
from registration.calibrate.guided import FaceImage, guided_match
from registration.calibrate.lengths import check_lengths, sized
from registration.calibrate.metric import fit_model
from registration.calibrate.options import CalibrateOptions
from registration.calibrate.photographs import (
    Photograph,
    duplicates,
    find_photographs,
    focal_groups,
    read_pixels,
)
from registration.calibrate.result import Calibration, collect
from registration.calibrate.start import EXIF_SIGMA, Focals, Start, angles, landmark_observations, start_from_faces
from registration.detect.provider import Face, LandmarkProvider
from registration.detect.providers import load_provider
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme, schemes_beside, shipped_schemes
from registration.progress import NullProgress, Progress

MAX_SIDE_PX = 2400  # of the images that features and faces are searched in
_MAX_ANGLE = np.radians(65.0)  # between the viewing directions of views that are matched
_USUAL_MATCHES = 150  # of a view with all others, by the median: then one with next to none is wrong
_NEXT_TO_NONE = 0.05  # of the usual ones
_FEW_KEPT = 0.2  # of the usual number of points in a view: below, it is compared as a mirror image
_NEAR = np.radians(35.0)  # between the viewing directions of views whose features should match
_MIN_PRESENCE = 0.5
_FEW_MATCHES = 200  # of a view with all others: below, faces are matched by their landmarks' help
_NEIGHBOURS = 4  # with which they are
_SEEN = 0.3  # confidence of a landmark, above which the camera sees it
_DEFAULTS = CalibrateOptions()


def calibrate_photographs(
    images: Path | Sequence[Path],
    model: Path,
    options: CalibrateOptions = _DEFAULTS,
    *,
    provider: LandmarkProvider | None = None,
    scheme: LandmarkScheme | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate the cameras of photographs of one moment.

    Views that show a face are posed by its landmarks and the mean head; features matched between views give points,
    further views are posed by these, and a bundle adjustment fits everything. The head model fitted to the landmarks
    gives the world's frame and unit.

    Args:
        images: a folder, with subfolders, or image files.
        model: the head model's NPZ file.
        options: see there.
        provider: of landmarks, instead of the one that the options name.
        scheme: the model's map of the landmarks, instead of the one beside the model or shipped.
        progress: receives steps and messages.

    Raises:
        InputError: the images cannot be used, too few show a face or agree, the focal length is missing for two views,
            or the model has no map of the landmarks.
    """
    progress = NullProgress() if progress is None else progress
    photographs = find_photographs(images)
    root = images if isinstance(images, Path) else photographs[0].file.parent
    data = gnm_npz.read(Path(model))
    provider = load_provider(options.provider) if provider is None else provider
    scheme = _scheme(Path(model), data, provider) if scheme is None else scheme
    check_lengths(options, photographs, scheme.name)
    copies = duplicates(photographs)
    left_out = {photographs[i].name: f"the same file as {photographs[j].relative}" for i, j in copies.items()}
    photographs = [photograph for i, photograph in enumerate(photographs) if i not in copies]
    names, group = focal_groups(photographs, options.group_by)
    focals = _known_focals(photographs, names, group, options)
    _check_count(photographs, root, bool(np.isfinite(focals.px).all()))

    faces, features, notes = _look(photographs, provider, progress)
    _check_faces(faces, photographs, root)
    landmarks = landmark_observations(faces)
    centres = np.array([photograph.centre_px for photograph in photographs])
    mean = scheme.points(data.template_vertex_positions.astype(np.float64))
    start = start_from_faces(landmarks, mean, scheme.spread_m, centres, group, focals)
    plain = _match(features, match_pairs(start, _MAX_ANGLE), progress)
    matches = plain | _match_faces(photographs, faces, features, start, plain)
    evidence = _evidence(start, landmarks, features, matches, photographs)

    def run(evidence: Evidence, start: Start) -> Assembled:
        return assemble(
            start,
            evidence,
            focals,
            lambda points: fit_model(data, scheme, points),
            scheme.spread_m,
            distortion=options.distortion,
            report=progress.message,
        )

    assembled = run(evidence, start)
    wrong = _disagreeing(assembled, features, plain)
    if wrong:
        start, evidence = _without(start, evidence, list(wrong))
        assembled = run(evidence, start)
    reasons = {
        view: wrong.get(view) or _reason(view, faces, start, evidence)
        for view in np.flatnonzero(~assembled.posed).tolist()
    }
    left_out |= {photographs[view].name: reason for view, reason in reasons.items()}
    if assembled.posed.sum() < 2:
        raise _too_few(root, assembled, left_out)
    assembled, size = sized(assembled, photographs, options, left_out)
    return collect(
        root,
        photographs,
        focals=focals,
        assembled=assembled,
        left_out=left_out,
        size=size,
        notes=notes,
        scheme=scheme.name,
    )


def _scheme(model: Path, data: gnm_npz.GNMData, provider: LandmarkProvider) -> LandmarkScheme:
    """The model's map of the provider's landmarks. Raises InputError."""
    schemes = shipped_schemes(data) | schemes_beside(model, data.template_vertex_positions)
    if provider.scheme not in schemes:
        raise InputError(
            "The model has no map of the landmarks",
            where=model,
            expected=f"head_sparse_{provider.scheme}.txt beside the model, or a map shipped for its topology",
            got=", ".join(sorted(schemes)) or "no landmark scheme",
            fix=f"make one with `gnmreg model landmarks --provider {provider.scheme}`",
        )
    scheme = schemes[provider.scheme]
    if len(scheme.indices) != provider.count:
        raise InputError(
            "The model's map is of other landmarks",
            where=model,
            expected=f"{provider.count} landmarks of scheme {provider.scheme}",
            got=len(scheme.indices),
            fix=f"make the map again with `gnmreg model landmarks --provider {provider.scheme}`",
        )
    return scheme


def _known_focals(
    photographs: Sequence[Photograph], names: Sequence[str], group: np.ndarray, options: CalibrateOptions
) -> Focals:
    """What is known of the groups' focal lengths, and from where."""
    px, sigma, side, sources = [], [], [], []
    for number in range(len(names)):
        members = [photograph for photograph, g in zip(photographs, group, strict=True) if g == number]
        by_exif = [photograph.focal_px for photograph in members if photograph.focal_px is not None]
        side.append(float(max(photograph.side_px for photograph in members)))
        if options.focal_px is not None:
            px.append(options.focal_px)
            sigma.append(0.0)
            sources.append("given")
        elif by_exif:
            px.append(float(np.median(by_exif)))
            sigma.append(EXIF_SIGMA)
            sources.append("EXIF")
        else:
            px.append(np.nan)
            sigma.append(np.inf)
            sources.append("unknown")
    spread = 0.0 if options.focal_px is not None or options.group_by == "view" else options.focal_spread
    return Focals(
        px=np.array(px),
        sigma=np.array(sigma),
        side_px=np.array(side),
        deviation_sigma=spread,
        names=tuple(names),
        sources=tuple(sources),
    )


def _check_count(photographs: Sequence[Photograph], root: Path, focal_known: bool) -> None:
    """Refuse too few photographs. Raises InputError."""
    if len(photographs) >= 3 or (len(photographs) == 2 and focal_known):
        return
    two = len(photographs) == 2
    raise InputError(
        "Two photographs do not tell their focal length" if two else "Cameras cannot be estimated from one photograph",
        where=root,
        expected="three photographs or more from different sides, or two with a known focal length",
        got=", ".join(str(photograph.relative) for photograph in photographs),
        fix="give the focal length with --focal-px, or add photographs" if two else "add photographs",
    )


def _look(
    photographs: Sequence[Photograph], provider: LandmarkProvider, progress: Progress
) -> tuple[list[Face | None], list[Features], list[str]]:
    """Search all photographs for a face and for features; pixels are those of the files."""
    faces: list[Face | None] = []
    features, notes = [], []
    for number, photograph in enumerate(photographs):
        progress.update(number, len(photographs), "faces and features")
        pixels, factor = read_pixels(photograph, MAX_SIDE_PX)
        found = [face for face in provider.detect(pixels) if face.presence >= _MIN_PRESENCE]
        if len(found) > 1:
            found.sort(key=lambda face: -float(np.prod(face.box[2:] - face.box[:2])))
            notes.append(f"{photograph.name}: {len(found)} faces, the largest is used")
        faces.append(_of_the_file(found[0], factor) if found else None)
        features.append(find_features(pixels, factor))
    progress.update(len(photographs), len(photographs), "faces and features")
    return faces, features, notes


def _of_the_file(face: Face, factor: float) -> Face:
    """The face in pixels of the file, `factor` times those that it was found in."""
    return replace(face, points=face.points * factor, spread_px=face.spread_px * factor, box=face.box * factor)


def _check_faces(faces: Sequence[Face | None], photographs: Sequence[Photograph], root: Path) -> None:
    """Refuse photographs of which fewer than two show a face. Raises InputError."""
    shown = [photograph.name for photograph, face in zip(photographs, faces, strict=True) if face is not None]
    if len(shown) < 2:
        raise InputError(
            "Too few photographs show a face",
            where=root,
            expected="two photographs or more in which the detector finds a face, within about 45 degrees of the front",
            got=f"{len(shown)} of {len(photographs)}" + (f": {shown[0]}" if shown else ""),
            fix="add photographs from the front and its sides, upright and sharp, in which the face is large",
        )


def _match(
    features: Sequence[Features], pairs: Sequence[tuple[int, int]], progress: Progress
) -> dict[tuple[int, int], np.ndarray]:
    """Match pairs of views in parallel; OpenCV and NumPy release the interpreter's lock."""
    found = {}
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        results = pool.map(lambda pair: match(features[pair[0]], features[pair[1]]), pairs)
        for number, (pair, result) in enumerate(zip(pairs, results, strict=True)):
            progress.update(number + 1, len(pairs), "matches")
            if len(result):
                found[pair] = result
    return found


def _match_faces(
    photographs: Sequence[Photograph],
    faces: Sequence[Face | None],
    features: list[Features],
    start: Start,
    matches: Matches,
) -> dict[tuple[int, int], np.ndarray]:
    """Match faces of views with few matches, guided by landmarks; their features are added to `features`."""
    total = np.zeros(len(photographs), np.int64)
    for pair, found in matches.items():
        total[list(pair)] += len(found)
    shown = [view for view in np.flatnonzero(start.posed).tolist() if faces[view] is not None]
    pairs: set[tuple[int, int]] = set()
    for view in (view for view in shown if total[view] < _FEW_MATCHES):
        angle = angles(start.rig, view)
        near = sorted((other for other in shown if other != view), key=lambda other: float(angle[other]))
        pairs |= {(min(view, other), max(view, other)) for other in near[:_NEIGHBOURS] if angle[other] < _MAX_ANGLE}
    added = {}
    for i, j in sorted(pairs):
        first, second = (_face_image(photographs[view], faces[view]) for view in (i, j))
        seen, new = guided_match(first, second, features[j])
        if len(new):
            plain = matches.get((i, j), np.zeros((0, 2), np.int64))
            added[i, j] = np.concatenate([plain, new + [len(features[i].xy_px), 0]])
            features[i] = joined(features[i], seen)
    return added


def _face_image(photograph: Photograph, face: Face | None) -> FaceImage:
    assert face is not None
    pixels, factor = read_pixels(photograph, MAX_SIDE_PX)
    return FaceImage(pixels=pixels, points=face.points / factor, seen=face.confidence > _SEEN, factor=factor)


def _evidence(
    start: Start,
    landmarks: Observations,
    features: Sequence[Features],
    matches: Matches,
    photographs: Sequence[Photograph],
) -> Evidence:
    view, feature, track = tracks(features, matches)
    first = np.concatenate([[0], np.cumsum([len(one.xy_px) for one in features])])[view] + feature
    return Evidence(
        landmarks=landmarks.where(start.posed[landmarks.view]),
        tracks=Observations(
            view=view,
            point=track,
            xy_px=np.concatenate([one.xy_px for one in features])[first],
            sigma_px=np.concatenate([one.sigma_px for one in features])[first],
        ),
        track_count=int(track.max(initial=-1)) + 1,
        side_px=np.array([float(photograph.side_px) for photograph in photographs]),
    )


def _disagreeing(assembled: Assembled, features: Sequence[Features], plain: Matches) -> dict[int, str]:
    """Views of which next to no feature matches a near view, although those of others do: view -> what it seems to be.

    Matches that landmarks guided do not count: symmetric faces, and faces of two people, have some.
    """
    total, posed = np.zeros(len(assembled.posed), np.int64), np.flatnonzero(assembled.posed).tolist()
    for pair, found in plain.items():
        if assembled.posed[list(pair)].all():
            total[list(pair)] += len(found)
    usual = float(np.median(total[posed]))
    if usual < _USUAL_MATCHES:
        return {}
    kept = np.bincount(assembled.observations.view[~assembled.of_landmarks], minlength=len(total))
    wrong = {}
    for view in posed:
        angle = angles(assembled.adjusted.rig, view)
        others = [other for other in posed if other != view]
        near = any(angle[other] < _NEAR for other in others)
        few = total[view] < max(MIN_MATCHES, _NEXT_TO_NONE * usual)
        if not near or not (few or kept[view] < _FEW_KEPT * np.median(kept[posed])):
            continue
        turned = mirrored(features[view])
        flipped = sum(len(match(turned, features[other])) for other in others)
        if flipped > 3 * max(total[view], MIN_MATCHES):
            wrong[view] = (
                f"it is mirrored: {flipped} of its features match the other photographs when it is turned over, "
                f"{total[view]} as it is"
            )
        elif few:
            wrong[view] = (
                f"its features do not agree with the other photographs ({total[view]} match, usual are {usual:.0f}): "
                "another person, another moment, or blur"
            )
    return wrong


def _without(start: Start, evidence: Evidence, views: Sequence[int]) -> tuple[Start, Evidence]:
    """Start and evidence without some views."""
    posed = start.posed.copy()
    posed[list(views)] = False
    kept = replace(
        evidence,
        landmarks=evidence.landmarks.where(~np.isin(evidence.landmarks.view, views)),
        tracks=evidence.tracks.where(~np.isin(evidence.tracks.view, views)),
    )
    return replace(start, posed=posed), kept


def _reason(view: int, faces: Sequence[Face | None], start: Start, evidence: Evidence) -> str:
    """Why a view could not be posed."""
    features = f"{int((evidence.tracks.view == view).sum())} of its features match another photograph"
    if view in start.wrong:
        return f"the face in it does not fit those in the others (another person, or another moment), and {features}"
    if faces[view] is None:
        return f"no face was found in it, and only {features}: too few to pose it"
    return f"it could not be posed, {features}"


def _too_few(root: Path, assembled: Assembled, left_out: Mapping[str, str]) -> InputError:
    reasons = [f"{name}: {reason}" for name, reason in left_out.items()]
    return InputError(
        "The photographs do not agree",
        where=root,
        expected="two photographs or more of one person at one moment",
        got=f"{int(assembled.posed.sum())} that agree; " + "; ".join(reasons[:3]),
        fix="remove photographs of other people or moments, and blurred ones",
    )
