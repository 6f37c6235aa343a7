"""`gnmreg stabilize review`: a page in the browser for decisions about components [GNM, Head Expression]."""

import threading
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.model import gnm_npz, regions
from registration.progress import Progress
from registration.report.glb import AMPLITUDE_SIGMAS, animated_glb
from registration.report.heat_map import scale_limit_mm
from registration.report.pictures import scale_colours
from registration.stabilize import stabilized_folder as disk
from registration.stabilize.components import HeadGeometry, RegionalComponents
from registration.stabilize.decisions import ACTIONS
from workflows.records.decisions import read_decisions
from workflows.records.run import Selection
from workflows.steps.stabilize import LOG, stabilize_run
from workflows.web import panels
from workflows.web.review_state import ReviewState
from workflows.web.server import PageServer, literal

_OFFSET_M = 0.15  # of each head from the centre
_TORN = (220, 20, 40)  # colour of torn edges


def review(
    run: Path,
    *,
    model_path: Path,
    out: Path | None = None,
    decisions: Path | None = None,
    skip_failed: bool = False,
    port: int = 8080,
    progress: Progress | None = None,
) -> "ReviewPage":
    """Stabilize the run where necessary, start the page's server and return it.

    Raises:
        InputError: as `stabilize_run`; the log at `decisions` belongs to another dataset; the port is in use.
    """
    outcome = stabilize_run(
        run,
        model_path=model_path,
        out=out,
        selection=Selection(skip_failed=skip_failed),
        reuse="any decisions",
        progress=progress,
    )
    log = Path(run) / LOG if decisions is None else Path(decisions)
    saved = read_decisions(log, outcome.dataset) if log.is_file() else []
    head = HeadGeometry.from_model(gnm_npz.read(model_path))
    return ReviewPage(ReviewState(disk.read_components(outcome.out), head, log, outcome.dataset, saved), port)


class ReviewPage(PageServer):
    """The page of one review; all browsers share one state."""

    def __init__(self, review: ReviewState, port: int):
        self.review = review
        self._lock = threading.Lock()
        self._parts = {part.region: part for part in review.stored.components if len(part.energy)}
        if not self._parts:
            raise InputError(
                "There is nothing to review",
                where="displacements of all samples",
                expected="expressions that differ from the neutral",
                got="no displacement",
                fix="check that the expressions are not copies of the neutral",
            )
        data = review.head.data
        shells = np.logical_or(*regions.eyeball_shells(data))
        self._vertices = np.flatnonzero(regions.exterior(data) | shells)
        number = np.full(len(review.head.points), -1)
        number[self._vertices] = np.arange(len(self._vertices))
        faces = number[data.triangles]
        self._faces = faces[(faces >= 0).all(1)]
        self._torn: Any = None  # what shows the torn edges
        self._moving = False
        super().__init__(port, "Stabilization")
        self._build()

    @property
    def _part(self) -> RegionalComponents:
        return self._parts[self._region.value.replace(" ", "_")]

    @property
    def _component(self) -> int:
        return int(self._number.value) - 1

    def _build(self) -> None:
        """Create the scene and the controls."""
        server, gui = self._server, self._server.gui
        server.scene.set_up_direction("+y")
        server.scene.add_light_directional("/key", intensity=1.6, position=(-0.5, 0.7, 1.0))
        server.initial_camera.position = (0.0, 0.0, 0.78)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.fov = np.radians(38)
        samples, subjects = len(self.review.stored.labels), len(set(self.review.stored.subjects))
        gui.add_markdown(f"### Head motion in expressions\n{samples} expressions of {subjects} subjects")
        names = tuple(region.replace("_", " ") for region in self._parts)
        # viser's setters have types of their own that type checkers take for read-only properties.
        self._work = gui.add_html("")
        turn = gui.add_button_group("Undecided", ("previous undecided", "next undecided"))
        self._region: Any = gui.add_dropdown("Region", names)
        self._number: Any = gui.add_slider("Component", min=1, max=2, step=1, initial_value=1)
        steps = gui.add_button_group("Step", ("previous", "next"))
        self._about = gui.add_html("")
        self._action: Any = gui.add_button_group("Action", ACTIONS)
        self._reason: Any = gui.add_text("Reason", "")
        self._error = gui.add_html("")
        undo, save = gui.add_button("Undo"), gui.add_button("Save decisions")
        self._message = gui.add_markdown("")
        self._bar, self._histogram, self._strongest = (gui.add_html("") for _ in range(3))
        for text, x in (("before", -_OFFSET_M), ("after", _OFFSET_M)):
            server.scene.add_label(f"/{text} label", text, position=(x, -0.185, 0.0))
        self._region.on_update(lambda _: self._on_control(1))
        self._number.on_update(lambda _: self._on_control(self._component + 1))
        steps.on_click(lambda _: self._select(self._component + 1 + (1 if steps.value == "next" else -1)))
        turn.on_click(lambda _: self._turn(1 if turn.value == "next undecided" else -1))
        self._action.on_click(lambda _: self._decide())
        undo.on_click(lambda _: self._undo())
        save.on_click(lambda _: self._save())
        first = self.review.work_list()[0]
        self._go_to(first.region, first.component)

    def _select(self, number: int) -> None:
        """Show the component of this number, from 1, or the nearest one that the region has."""
        self._go_to(self._part.region, number - 1)

    def _on_control(self, number: int) -> None:
        """Show the component of this number when an operator changed a control, not this page."""
        if not self._moving:
            self._select(number)

    def _turn(self, step: Literal[-1, 1]) -> None:
        """Show the next or previous undecided component."""
        with self._lock:
            item = self.review.undecided(self._part.region, self._component, step)
        if item is None:
            self._message.content = "All others are decided."
            return
        self._go_to(item.region, item.component)

    def _go_to(self, region: str, component: int) -> None:
        """Show a component of a region."""
        count = len(self._parts[region].energy)
        self._moving = True  # a change of the controls must not show what is between
        try:
            self._region.value = region.replace("_", " ")
            self._number.max = max(count, 2)
            self._number.value = int(np.clip(component + 1, 1, count))
        finally:
            self._moving = False
        self._show()

    def _decide(self) -> None:
        with self._lock:
            self.review.decide(self._part.region, self._component, self._action.value, self._reason.value)
            self._reason.value = ""
        self._show()

    def _undo(self) -> None:
        with self._lock:
            last = self.review.undo()
        if last is None:
            self._message.content = "There is no unsaved decision to undo."
            return
        self._go_to(last.region, last.component)
        self._message.content = "Undone."

    def _save(self) -> None:
        with self._lock:
            try:
                count = self.review.save()
                tearing = len(self.review.tearing)
                warning = f" **{tearing} of all decisions tear the mesh.**" if tearing else ""
                self._message.content = f"{count} decisions saved in {literal(str(self.review.log))}.{warning}"
            except (InputError, OSError) as error:
                self._message.content = f"Not saved: {literal(str(error))}"
        self._show()

    def _show(self) -> None:
        """Show the current state."""
        with self._lock:
            part, k = self._part, min(self._component, len(self._part.energy) - 1)
            review = self.review
            action, stretch = review.action(part.region, k), review.stretch(part.region, k)
            self._work.content = panels.work_list(review.work_list(), (part.region, k))
            self._about.content = panels.about(part, k, action, review.head, stretch)
            self._error.content = panels.error(review.effect, review.unsaved, review.tearing)
            self._histogram.content = panels.histogram(part.coefficients[:, k], review.stored.labels)
            self._strongest.content = panels.strongest(part, k, review.stored)
            before, after = (motion[self._vertices] for motion in review.motions(part.region, k))
            size_mm = 1e3 * AMPLITUDE_SIGMAS * np.linalg.norm(before, axis=1)
            limit = scale_limit_mm(size_mm)
            self._bar.content = panels.colour_bar(limit, "Displacement at 3 σ")
            points = review.head.points[self._vertices]
            for name, motion, x in (("before", before, -_OFFSET_M), ("after", after, _OFFSET_M)):
                colours = scale_colours(1e3 * AMPLITUDE_SIGMAS * np.linalg.norm(motion, axis=1) / limit)
                glb = animated_glb(points, motion, self._faces, colours)
                self._server.scene.add_glb(f"/{name}", glb, position=(x, 0.0, 0.0))
            torn = stretch.torn if action == "drop" else stretch.torn[:0]
            self._show_torn(review.head.points[torn])

    def _show_torn(self, lines: Float[np.ndarray, "N 2 3"]) -> None:
        """Draw the torn edges on the head after the decisions, at rest."""
        if self._torn is not None:
            self._torn.remove()
            self._torn = None
        if len(lines):
            position = (_OFFSET_M, 0.0, 0.0)
            lines = lines.astype(np.float32)
            self._torn = self._server.scene.add_line_segments("/torn", lines, _TORN, thickness=6e-4, position=position)
