"""Files of a capture folder that nothing reads, each with what it probably was meant to be."""

import difflib
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from registration.capture.scan import SCAN, SCANS, unread_scans
from registration.capture.text import listed
from registration.doctor import findings
from registration.doctor.findings import Finding, refuse
from registration.doctor.fixes import RenameFix
from registration.types import Capture

SUFFIXES = {
    "masks": ".png",
    "normals": ".png",
    "depth": ".png",
    "confidence": ".png",
    "segmentation": ".png",
    "landmarks": ".json",
}  # besides images/
_ROOT_FILES = ("capture.toml", *SCANS, "ground_truth.npz")
_OTHER_FOLDERS = {
    "image": "images",
    "rgb": "images",
    "input": "images",
    "mask": "masks",
    "matte": "masks",
    "mattes": "masks",
    "alpha": "masks",
    "silhouettes": "masks",
    "normal": "normals",
    "normal_maps": "normals",
    "depths": "depth",
    "depth_maps": "depth",
    "confidences": "confidence",
    "confidence_maps": "confidence",
    "labels": "segmentation",
    "label": "segmentation",
    "seg": "segmentation",
    "segm": "segmentation",
    "segmentations": "segmentation",
    "semantic": "segmentation",
    "semantics": "segmentation",
    "parsing": "segmentation",
    "landmark": "landmarks",
    "lmk": "landmarks",
    "lmks": "landmarks",
    "keypoints": "landmarks",
}
_SUFFIXES = "png|jpe?g|tiff?|bmp|webp|exr|json|txt|pts|csv|npy|npz"
_ROLES = "mask|matte|alpha|normals?|labels?|seg|segmentation|parsing|landmarks?|lmks?|keypoints"
_NO_CONTENT = ("thumbs.db", "desktop.ini", "readme", "readme.md", "readme.txt", "license", "license.txt", "licenses.md")


@dataclass(frozen=True, kw_only=True)
class FolderFiles:
    """The files of one channel's folder."""

    files: int  # on disk
    matched: int  # that belong to a view
    unmatched: Mapping[str, str | None]  # path below the folder -> the path that it probably was meant to have


def match_files(capture: Capture) -> dict[str, FolderFiles]:
    """Match the files of images/, masks/, landmarks/ and the other channels with the views."""
    result = {}
    for folder, expected in _expected(capture).items():
        on_disk = files_in(capture.root / folder)
        unmatched = [name for name in on_disk if name not in expected]
        missing = set(expected) - set(on_disk)
        result[folder] = FolderFiles(
            files=len(on_disk),
            matched=len(on_disk) - len(unmatched),
            unmatched={name: nearest(name, missing) or nearest(name, expected) for name in unmatched},
        )
    return result


def require_matches(capture: Capture, files: Mapping[str, FolderFiles]) -> None:
    """Refuse a folder with files of which none belongs to a view. Raises InputError."""
    for folder, found in files.items():
        if not found.unmatched or found.matched:
            continue
        unmatched = list(found.unmatched)
        name = next((name for name in unmatched if found.unmatched[name] is not None), unmatched[0])
        near = found.unmatched[name] or _expected(capture)[folder][0]
        raise refuse(
            "files-unmatched",
            f"No file in {folder}/ belongs to a view",
            where=capture.root / folder,
            expected=f"the names of the views, as {near}",
            got=f"{len(unmatched)} other files, as {name}",
            fix=_conversion(name, near),
            mend=rename_mend(folder, found),
        )


def rename_mend(folder: str, found: FolderFiles) -> RenameFix | None:
    """The new names of files that belong to no view as they are; None if for one it is not certain."""
    targets = list(found.unmatched.values())
    suffixes = [{PurePosixPath(name).suffix.casefold() for name in pair if name} for pair in found.unmatched.items()]
    if not targets or None in targets or len(set(targets)) < len(targets) or any(len(s) > 1 for s in suffixes):
        return None
    names = {f"{folder}/{name}": f"{folder}/{near}" for name, near in found.unmatched.items()}
    return RenameFix(what=f"renamed {len(names)} files in {folder}/ as their views", names=names)


def unread(capture: Capture, files: Mapping[str, FolderFiles]) -> list[Finding]:
    """Name the files and folders that are not read, one warning for each folder."""
    lines: list[Finding] = []
    for folder, found in files.items():
        if not found.unmatched or not found.matched:  # `require_matches` refuses the latter
            continue
        shown = [name if near is None else f"{name} (near {near})" for name, near in found.unmatched.items()]
        what = "are not calibrated, the COLMAP model does not name them" if folder == "images" else "belong to no view"
        line = f"{len(shown)} files in {folder}/ {what}: {listed(shown, 5)}"
        lines.append(Finding.warning("files-unread", line))
    known = {"sparse", *files}
    for path in sorted(capture.root.iterdir()):
        if path.name.startswith(".") or path.name in known or path.name in _ROOT_FILES:
            continue
        if path.is_dir():
            plain = path.name.casefold()
            meant = plain if plain in known else _OTHER_FOLDERS.get(plain)
            if meant is not None and (count := len(files_in(path))):
                line = f"{path.name}/ with {count} files is not read; rename it to {meant}/"
                fix = RenameFix(what=f"renamed {path.name}/ to {meant}/", names={path.name: meant})
                free = not (capture.root / meant).exists() or meant.casefold() == path.name.casefold()
                lines.append(Finding.warning("files-unread", line, fix if free else None))
        elif (meant := _meant_root_file(path)) is not None and not (capture.root / meant).exists():
            line = f"{path.name} is not read; convert or rename it to {meant}"
            lines.append(Finding.warning("files-unread", line))
    return lines + findings.warnings("files-unread", _other_scans(capture))


def _other_scans(capture: Capture) -> list[str]:
    """A line about meshes in other files or formats than the scan's."""
    if not (names := unread_scans(capture.root)):
        return []
    mend = (
        f"convert or rename it to {SCAN}"
        if capture.scan is None
        else f"{capture.scan.name} is; remove what is out of date"
    )
    return [f"{listed(names)} is not read; {mend}"]


def files_in(folder: Path) -> list[str]:
    """Return the paths of all files below a folder, relative to it, sorted; hidden ones and notes are left out."""
    found = []
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith((".", "__MACOSX"))]
        found += [
            (Path(parent) / name).relative_to(folder).as_posix()
            for name in names
            if not name.startswith(".") and name.casefold() not in _NO_CONTENT
        ]
    return sorted(found)


def nearest(name: str, candidates: Iterable[str]) -> str | None:
    """Return the candidate that a path probably was meant to be: equal but for case, suffixes, folders or a letter."""
    names = sorted(candidates)
    for key in (str.casefold, _stem, _last):
        equal = [candidate for candidate in names if key(candidate) == key(name)]
        if equal and (key is not _last or len(equal) == 1):
            return equal[0]
    # Numbers must be equal: cam02 is no misspelling of cam01.
    by_stem = {_stem(candidate): candidate for candidate in names if _digits(candidate) == _digits(name)}
    close = difflib.get_close_matches(_stem(name), by_stem, 1, 0.7)
    return by_stem[close[0]] if close else None


def _expected(capture: Capture) -> dict[str, list[str]]:
    """Folder -> the paths below it that belong to the views."""
    images = capture.root / "images"
    expected = {"images": [view.image.relative_to(images).as_posix() for view in capture.views]}
    for folder, suffix in SUFFIXES.items():
        read = _read_files(capture, folder)
        expected[folder] = [read.get(view.name, view.name + suffix) for view in capture.views]
    return expected


def _read_files(capture: Capture, folder: str) -> dict[str, str]:
    """View's name -> the path below the folder of the file that was read for it."""
    if folder == "landmarks":
        names = {view.name: (view.name, view.image.relative_to(capture.root / "images")) for view in capture.views}
        paths = {view: [f"{stem}.json", f"{image.as_posix()}.json"] for view, (stem, image) in names.items()}
        return {
            view: next((path for path in found if (capture.root / folder / path).is_file()), found[0])
            for view, found in paths.items()
        }
    field = {"masks": "mask"}.get(folder, folder)
    read = {view.name: getattr(view, field) for view in capture.views}
    return {name: path.relative_to(capture.root / folder).as_posix() for name, path in read.items() if path is not None}


def _meant_root_file(path: Path) -> str | None:
    name = path.name.casefold()
    for expected in _ROOT_FILES:
        if expected in SCANS:  # `_other_scans` finds them
            continue
        if name == expected or (PurePosixPath(name).stem == PurePosixPath(expected).stem):
            return expected
    return None


def _conversion(name: str, near: str) -> str:
    """How to turn the file into one that is read."""
    have, want = PurePosixPath(name).suffix.casefold(), PurePosixPath(near).suffix.casefold()
    if have == want:
        return f"rename the files as their views, e.g. {name} to {near}"
    kind = want.removeprefix(".").upper()
    return f"convert the files to {kind} and name them as their views, e.g. {name} to {near}"


def _stem(path: str) -> str:
    """The path without case, suffixes, a leading images/ and what says that it is a mask or the like."""
    plain = path.replace("\\", "/").casefold().removeprefix("./").removeprefix("images/")
    plain = re.sub(rf"(\.({_SUFFIXES}))+$", "", plain)
    return re.sub(rf"(^|/)({_ROLES})[-_. ]|[-_. ]({_ROLES})$", r"\1", plain)


def _last(path: str) -> str:
    return _stem(path).rpartition("/")[2]


def _digits(path: str) -> list[int]:
    return [int(digits) for digits in re.findall(r"\d+", _stem(path))]
