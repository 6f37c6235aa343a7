"""Which folders, files and URLs the jobs of a service may use, and the short names of uploads and models."""

from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.terminal import printable
from workflows.ids import OutsideRoots, check_id, check_location, is_remote, resolve_roots
from workflows.service.problems import Problem
from workflows.service.settings import CAPTURES, MODELS, RESULTS, ServiceSettings

OFFERED = (CAPTURES, MODELS, RESULTS)  # folders of the farm that requests may name: the others hold queue, logs, tokens
FIRST, OFFICIAL = "first", "official"  # models that may be in this machine's cache
EXTRA = ".extra.npz"  # ending of a model's second file
BESIDE_MODELS = "head_cranium.npz"  # an auxiliary model, which is no head model itself


class Places:
    """The places of one service."""

    def __init__(self, settings: ServiceSettings) -> None:
        """Resolve the roots. Raises InputError for one that cannot be used."""
        self.roots = resolve_roots(settings.all_roots)
        self.farm = Path(self.roots[0])
        self.captures, self.models, self.results = (self.farm / name for name in OFFERED)

    @property
    def offered(self) -> list[str]:
        """Folders and URLs that contain all places which requests may name."""
        return [str(self.farm / name) for name in OFFERED] + list(self.roots[1:])

    def check(self, location: str, where: str) -> str:
        """Return a path or URL, in the form in which it is opened, if jobs may use it.

        Raises:
            Problem: 403 if it lies outside the roots or among the service's own files; 422 if it is malformed.
        """
        try:
            place = check_location(location, self.roots, where)
        except OutsideRoots as error:
            raise self._foreign(where, got=error.got) from None
        except InputError as error:
            raise Problem.of_input(error) from None
        if not self._is_offered(place):
            raise self._foreign(where, got=repr(printable(location)[:200]))
        return place

    def of_row(self, place: Any, where: str) -> str:
        """Return a path or URL of a queue's row, in the form in which it is opened: others can write to the queue.

        Raises:
            Problem: 404 if it lies outside the roots.
            InputError: it is malformed.
        """
        try:
            return check_location(place, self.roots, where)
        except OutsideRoots as error:
            raise Problem(
                HTTPStatus.NOT_FOUND,
                "The results are outside the folders of the service",
                where=where,
                expected=error.expected,
                got=error.got,
                fix="start the service with --root and their folder",
            ) from None

    def allows(self, location: str) -> bool:
        """Return whether `check` accepts a location."""
        try:
            self.check(location, "place")
        except Problem:
            return False
        return True

    def out(self, location: str | None, run: str | None) -> str:
        """Return the place of a run's results.

        Args:
            location: a path, a URL or a name below the farm's folder of results; None: the run's name there.
            run: name of the run.

        Raises:
            Problem: as `check`, or the place contains the farm's folder, or neither is given.
        """
        if location is None:
            if run is None:
                raise _problem("The run has no name", where="run", expected="run, out or both", got="neither")
            return str(self.results / _checked(run, "run"))
        if _is_name(location):
            return str(self.results / _checked(location, "out"))
        place = self.check(location, "out")
        inside = Path(place).is_relative_to(self.farm) and not is_remote(place)
        if self.farm.is_relative_to(place) or (inside and self.results not in Path(place).parents):
            raise self._foreign("out", got=repr(printable(location)[:200]))
        return place

    def capture(self, location: str) -> Iterator[str]:
        """Yield the captures that a word names: a path or URL, an uploaded capture, or all of an uploaded subject.

        Raises:
            Problem: as `check`.
            InputError: there is no such upload.
        """
        if not _is_name(location):
            yield self.check(location, "captures")
            return
        folder = self.captures / _upload(location)
        found = [folder] if "/" in location else sorted(path for path in folder.glob("[!.]*") if path.is_dir())
        if not found or not all((path / "capture.toml").is_file() for path in found):
            raise InputError(
                "There is no such upload",
                where="captures",
                expected="SUBJECT/NAME of an uploaded capture, a path or a URL",
                got=repr(location[:200]),
                fix="list the uploads at /api/v1/captures",
            )
        yield from (self.check(str(path), "captures") for path in found)  # not a link that leads elsewhere

    def subject(self, location: str) -> str:
        """Return the folder of a subject: a path, or the name of an uploaded one. Raises Problem."""
        if not _is_name(location):
            return self.folder(location, "subject")
        return self.check(str(self.captures / _checked(location, "subject")), "subject")

    def folder(self, location: str, where: str) -> str:
        """Return a folder of this machine; "captures" stands for all uploads. Raises Problem."""
        if location == CAPTURES:
            return str(self.captures)
        place = self.check(location, where)
        if is_remote(place):
            raise _problem("A folder is needed", where=where, expected="a path that all processes see", got="a URL")
        return place

    def model(self, location: str) -> str | None:
        """Return the place of a model: a path, a URL, or a name below the farm's folder; None if that is unknown.

        Raises:
            Problem: as `check`.
        """
        if not _is_name(location):
            return self.check(location, "model")
        name = _checked(location, "model")
        file = next((file for known, file in self.stored_models() if known == name), None)
        return None if file is None else self.check(str(file), "model")

    def stored_models(self) -> Iterator[tuple[str, Path]]:
        """Yield the models in the farm's folder: NAME.npz, or the one file in the folder NAME."""
        for path in sorted(self.models.glob("[!.]*")) if self.models.is_dir() else ():
            if path.is_dir():
                files = [file for file in sorted(path.glob("[!.]*.npz")) if _is_model(file)]
                if len(files) == 1:
                    yield path.name, files[0]
            elif path.suffix == ".npz" and _is_model(path):
                yield path.stem, path

    def _is_offered(self, place: str) -> bool:
        path = Path(place)
        if is_remote(place) or not path.is_relative_to(self.farm):
            return True
        return path.relative_to(self.farm).parts[:1] in [(name,) for name in OFFERED]

    def _foreign(self, where: str, *, got: str) -> Problem:
        return Problem(
            HTTPStatus.FORBIDDEN,
            "The place is outside those of the service",
            where=where,
            expected=f"a path or URL below {', '.join(self.offered)}",
            got=got,
            fix="upload captures, or start the service with `gnmreg serve --root`",
        )


def _is_name(location: str) -> bool:
    """Whether a word is a name below one of the farm's folders, and no path or URL."""
    return not location.startswith("/") and ":" not in location


def _upload(location: str) -> str:
    name = _checked(location, "captures")
    if name.count("/") > 1:
        raise _problem(
            "There is no such upload", where="captures", expected="SUBJECT/NAME, or SUBJECT", got=repr(name[:200])
        )
    return name


def _checked(name: str, where: str) -> str:
    try:
        return check_id(name)
    except InputError as error:
        raise _problem("The name cannot be used", where=where, expected=error.expected, got=error.got) from None


def _is_model(file: Path) -> bool:
    return file.name != BESIDE_MODELS and not file.name.endswith(EXTRA)


def _problem(what: str, *, where: str, expected: str, got: str) -> Problem:
    return Problem(HTTPStatus.UNPROCESSABLE_ENTITY, what, where=where, expected=expected, got=got, fix="change it")
