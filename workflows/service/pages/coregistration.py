"""The page of a coregistration: verdict, rounds, curves, models, products, the reviews of its rounds."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from fastapi import APIRouter, Depends, Request
from starlette.responses import FileResponse, Response

from workflows.pages.coregistration_rows import ROUND_COLUMNS, failures, lead, progress, round_row, running_round
from workflows.records.round_files import RoundFiles, find_round_files
from workflows.service.access import need
from workflows.service.api.reviews import command, review_inputs
from workflows.service.coregistrations import Coregistration, coregistration, coregistrations, malformed
from workflows.service.middleware import SANDBOX
from workflows.service.pages.base import page
from workflows.service.pages.charts import curves
from workflows.service.problems import Problem
from workflows.service.state import Service

router = APIRouter(include_in_schema=False, dependencies=[Depends(need("viewer"))])
TYPES = {".html": "text/html", ".json": "application/json", ".npz": "application/octet-stream"}  # that are shown
MAX_FAILURES = 200


@router.get("/coregistrations/{run}")
def coregistration_page(state: Service, request: Request, run: str) -> Response:
    """Show a coregistration."""
    found = coregistration(state, run)
    try:
        shown = _shown(found)
    except (KeyError, TypeError, AttributeError, ValueError, IndexError):
        raise malformed(run) from None
    driver = state.board.entries.get(run)
    return page(
        request,
        "coregistration.html",
        run=run,
        state=driver.times.state if driver else "",
        reason=driver.reason if driver else "",
        columns=ROUND_COLUMNS,
        loopback=state.settings.is_loopback,
        **shown,
    )


@router.get("/coregistrations/{run}/files/{path:path}")
def product(state: Service, run: str, path: str) -> Response:
    """Return a product of a coregistration; its pages run in a sandbox."""
    folder = coregistration(state, run).folder
    name = PurePosixPath(path)
    if name.suffix not in TYPES or ".." in name.parts or "\0" in path:
        raise Problem.missing("file", path)
    file = (folder / name).resolve()
    if not file.is_relative_to(folder.resolve()) or not file.is_file():
        raise Problem.missing("file", path)
    attached = "attachment" if name.suffix == ".npz" else "inline"
    return FileResponse(
        file, media_type=TYPES[name.suffix], headers=SANDBOX, filename=name.name, content_disposition_type=attached
    )


@router.get("/models")
def models_page(state: Service, request: Request) -> Response:
    """Show all models: those that coregistrations built, and those in the farm's folder."""
    built = []
    for found in coregistrations(state):
        try:
            built.append({"run": found.run, "lead": lead(found.record), "models": _models(found)})
        except (KeyError, TypeError, AttributeError, ValueError, IndexError):
            continue
    folder = state.settings.folder / "models"
    files = [path for path in sorted(folder.rglob("*.npz")) if path.is_file()] if folder.is_dir() else []
    stored = [(path.relative_to(folder).as_posix(), f"{path.stat().st_size / 2**20:.0f} MB") for path in files]
    return page(request, "models.html", built=built, stored=stored, folder=str(folder))


def _shown(found: Coregistration) -> dict[str, Any]:
    record = found.record
    plan, components = record["plan"], str(record["at"])
    running = running_round(record)
    files = find_round_files(found.folder, plan)
    recipe = plan["options"]["recipe"]
    lost = failures(record["rounds"])
    return {
        "lead": lead(record),
        "verdict": record["verdict"],
        "progress": "" if running is None else progress(running, record, files),
        "dataset": Path(plan["dataset"]).name,
        "recipe": recipe if isinstance(recipe, str) else str(recipe["name"]),
        "training": len(plan["split"]["training"]),
        "held_out": len(plan["split"]["held_out"]),
        "rows": [round_row(number, row, record, components) for number, row in enumerate(record["rounds"], 1)],
        "components": components,
        "charts": curves(record),
        "models": _models(found),
        "products": [_products(found, item) for item in files],
        "reviews": _reviews(found, files),
        "lost": lost[:MAX_FAILURES],
        "more_lost": max(0, len(lost) - MAX_FAILURES),
    }


def _models(found: Coregistration) -> list[dict[str, Any]]:
    """The models with where they come from and their evaluation."""
    record, components = found.record, str(found.record["at"])
    rows = []
    for number, (name, file) in enumerate(record["models"].items()):
        built: Mapping[str, Any] = record["rounds"][number - 1]["build"] if number else {}
        folder = f"it{number - 1:02d}"
        pages = ((f"{folder}/model/index.html", "model"), (f"{folder}/evaluation/index.html", "evaluation"))
        rows.append(
            {
                "name": name,
                "file": str(file),
                "content_id": built.get("content_id", ""),
                "made_of": f"{built['registered']} registrations, {len(built['rejected'])} left out"
                if built
                else "given",
                "components": built.get("components", ""),
                "generalization": _at(record["generalization_mm"], name, components),
                "specificity": _at(record["specificity_mm"], name, components),
                "pages": [(title, _url(found, path)) for path, title in pages if (found.folder / path).is_file()],
            }
        )
    return rows


def _at(table: Mapping[str, Mapping[str, float]], name: str, components: str) -> str:
    value = table.get(name, {}).get(components)
    return "–" if value is None else f"{value:.3f}"


def _products(found: Coregistration, item: RoundFiles) -> dict[str, Any]:
    pages = [(subject.name, _url(found, subject.page)) for subject in item.subjects if subject.page]
    return {
        "title": item.name.replace("_", " "),
        "reported": item.reported,
        "captures": item.captures,
        "links": [(title, _url(found, path)) for title, path in item.products],
        "subjects": pages,
    }


def _reviews(found: Coregistration, files: tuple[RoundFiles, ...]) -> list[dict[str, Any]]:
    """The rounds that can be reviewed, the last first."""
    rounds = [item for item in files if item.name.startswith("it") and item.reported]
    rows = []
    for item in reversed(rounds):
        number = int(item.name[2:])
        try:
            rows.append({"name": item.name, "number": number, "command": command(*review_inputs(found, number))})
        except Problem:
            continue
    return rows


def _url(found: Coregistration, path: str) -> str:
    return f"/coregistrations/{quote(found.run)}/files/{quote(path)}"
