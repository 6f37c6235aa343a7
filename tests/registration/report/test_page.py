"""The page is complete, well-formed and self-contained, and escapes names."""

import html
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

from registration.evaluate.audit import audit_penetration
from registration.evaluate.residuals import residual_figures
from registration.model.gnm_npz import read
from registration.report import heat_map as heat_maps
from registration.report.charts import ChartLine, line_charts
from registration.report.inputs import ReportInputs, distance_heat_map
from registration.report.loss_curves import loss_curves
from registration.report.page import render_report
from registration.report.remarks import headline, remarks
from registration.storage.hashing import versions
from registration.storage.registration_folder import FILES
from registration.types import Registration
from tests.conftest import FIXTURES
from tests.registration.report.test_pictures import a_view

TEMPLATE = read(FIXTURES / "tiny_gnm.npz")
VOID = {"meta", "img", "br", "link", "input", "hr"}


def a_registration(**changes) -> Registration:
    def zeros(*shape):
        return np.zeros(shape, np.float32)

    row = {"points": 1234, "mean_mm": 0.1234, "median_mm": 0.0456, "std_mm": 0.2, "p95_mm": 1.456}
    fields = dict(
        status="converged",
        reason="the mesh is at rest",
        identity=zeros(1),
        expression=zeros(1),
        rotations=zeros(4, 3),
        translation=zeros(3),
        scale=np.array(1, np.float32),
        offsets=zeros(4, 3),
        vertices=np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32),
        triangles=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
        confidence=zeros(4),
        texture=zeros(2, 2, 3),
        corner_uvs=zeros(4, 3, 2),
        seconds={"rigid": 1.25, "offsets": 199.75},
        history={"rigid": {"landmarks": [3.0, 1.0]}, "offsets": {"colour": [1.0, 0.5], "l2": [0.0, 1e-3]}},
        figures={
            "scan_to_mesh": {"face": row, "seen": row},
            "scan_to_mesh_by_area": {"face": {**row, "dropped_normals": 0.02, "dropped_boundary": 0.0}},
        },
        config={"recipe": "draft", "stages": [{"steps": 30}]},
        inputs={"capture": "ab" * 32},
    )
    return Registration(**{**fields, **changes})


def some_inputs(**changes) -> ReportInputs:
    registration = changes.pop("registration", a_registration())
    fields = dict(
        registration=registration,
        subject="anna",
        expression="smile",
        views=(a_view(name="cam00"), a_view(name="cam01")),
        class_names=("skin", "left_eye"),
        heat_map=distance_heat_map(registration, np.array([0.1, 0.2, np.nan, 0.4])),
        files=FILES,
        versions=versions(),
    )
    return ReportInputs(**{**fields, **changes})


@pytest.fixture(autouse=True)
def coarse_heat_maps(monkeypatch):
    monkeypatch.setattr(heat_maps, "_OVERSAMPLING", 1)


class Balance(HTMLParser):
    """Fails on tags that do not close in order."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID and tag not in ("path", "use"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        if tag not in ("path", "use"):
            assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"


def check_page(page: str) -> None:
    balance = Balance()
    balance.feed(page)
    assert not balance.open
    links = re.findall(r'(?:src|href)="?([^"\s>]+)', page)
    ours = [link for link in links if link not in FILES]
    assert ours and all(link.startswith(("data:", "#")) for link in ours), "an external resource"
    assert "url(http" not in page and "@import" not in page


def test_a_full_page():
    page = render_report(some_inputs())
    check_page(page)
    for text in ("anna", "smile", "converged", "0.123", "1.46", "cam00", "cam01", "2.0 % excluded by normals"):
        assert text in page, text
    for text in ("subject&#39;s left", "left_eye", "3 min 21 s", "mitsuba", "ab" * 32, "&#34;recipe&#34;"):
        assert text in page, text
    assert page.count("data:image/jpeg") == 1 + 3 * 3 + 1 + 2 * 9  # poster, mesh from three sides, atlas, views
    sections = ("mesh", "distances", "views", "optimization", "files", "provenance")
    positions = [page.index(f'id="{name}"') for name in sections]
    assert positions == sorted(positions)


def test_an_empty_page_has_no_empty_sections():
    empty = {name: {} for name in ("seconds", "history", "figures", "config", "inputs")}
    vertices = np.full((4, 3), np.nan, np.float32)
    registration = a_registration(status="failed", reason="no initial guess", vertices=vertices, **empty)
    page = render_report(some_inputs(registration=registration, views=(), heat_map=None, versions={}, files={}))
    check_page(page + '<a href="#"></a>')
    assert "<section" not in page and "The registration failed: no initial guess." in page


def test_names_are_escaped():
    markup = '<script>alert("x")</script>'
    registration = a_registration(reason=markup, config={markup: markup}, inputs={markup: "0"}, seconds={markup: 1.0})
    inputs = some_inputs(
        registration=registration,
        subject=markup,
        expression=markup,
        class_names=(markup,),
        views=(a_view(name=markup),),
    )
    page = render_report(inputs)
    check_page(page)
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page


@pytest.mark.parametrize(
    ("status", "words"),
    [
        ("converged", "converged: the mesh is at rest"),
        ("stopped", "stopped before it converged"),
        ("failed", "failed"),
    ],
)
def test_the_headline_states_the_result(status, words):
    sentence = headline(a_registration(status=status))
    assert words in sentence and "0.123 mm from the mesh on average" in sentence and "95 % within 1.46 mm" in sentence
    assert "no scan" in headline(a_registration(status=status, figures={}))


def test_loss_curves_have_a_panel_per_stage():
    svg = ElementTree.fromstring(loss_curves(a_registration().history))
    words = {element.text for element in svg.iter("{http://www.w3.org/2000/svg}text")}
    assert {"rigid", "offsets", "landmarks", "colour", "l2", "step"} <= words
    gaps = {"a": {"x": [float("nan"), 0.0, -1.0, 2.0, 1.0]}, "empty": {"x": []}}
    svg_text = loss_curves(gaps)
    assert ElementTree.fromstring(svg_text) is not None and "empty" not in svg_text
    (line,) = re.findall(r'<path d="(M[^hH]*?)" stroke="#1f77b4" stroke-width="1.4"', svg_text)
    places = np.array([point.split() for point in re.split("[ML]", line)[1:]], float)
    assert line.count("M") == 1 and len(places) == 2  # of the fourth and fifth step
    assert places[0, 0] < places[1, 0] and places[0, 1] < places[1, 1]  # it falls
    whole = loss_curves({"a": {"x": [100.0, 10.0, 1.0]}})
    heights = [
        float(y)
        for y in re.findall(
            r"[ML][\d.]+ ([\d.]+)", re.findall(r'd="([^"]*)" stroke="#1f77b4" stroke-width="1.4"', whole)[0]
        )
    ]
    assert heights[1] == pytest.approx((heights[0] + heights[2]) / 2, abs=0.1)  # a logarithmic axis
    labels = {element.text for element in ElementTree.fromstring(whole).iter("{http://www.w3.org/2000/svg}text")}
    assert {"1", "2", "3", "10", "100"} <= labels
    assert loss_curves({}) == "" and loss_curves({"a": {}}) == ""


def test_line_charts_have_a_panel_per_title_and_bands():
    lines = [
        ChartLine(name="first", x=(5, 10), y=(2.0, 1.0), low=(1.5, None), high=(2.5, None)),
        ChartLine(name="next", x=(5, 10), y=(1.8, 0.8)),
    ]
    svg = ElementTree.fromstring(line_charts({"identity, mm": lines, "scans, mm": lines[:1], "none": []}, "components"))
    words = [element.text for element in svg.iter("{http://www.w3.org/2000/svg}text")]
    assert {"identity, mm", "scans, mm", "first", "next"} <= set(words) and "none" not in words
    assert words.count("components") == 2 and words.count("first") == 1
    assert line_charts({"none": []}, "components") == ""


def test_remarks_name_low_weights_exclusions_and_intersections():
    row = {"template_vertices": 3, "template_max_mm": 1.0, "vertices_beyond_0.3mm": 2, "max_excess_mm": 0.83}
    row["view"] = "cam07"
    figures = {
        "notes": ["landmarks 2-6 of scheme 68 do not fit the model's: excluded"],
        "views_not_trusted": {"cam03": "silhouette 35 px off the other views"},
        "intersections": {"pairs": {"tongue in gums": row, "ears in skin": {**row, "vertices_beyond_0.3mm": 0}}},
    }
    figures["scan_in_fit"] = {"normals": 22, "surface": 0.813}
    page = render_report(some_inputs(registration=a_registration(figures=figures)))
    used = "its normals in the 22 views without normal maps, its surface on 81% of the head"
    assert f"<li>The scan took part in the fit: {used}" in page
    assert "<li>View cam03 disagrees with the others and counts little: silhouette 35 px off the other views." in page
    assert "<li>Landmarks 2-6 of scheme 68 do not fit" in page
    sentence = "2 vertices of the tongue lie inside the gums, worst 0.8 mm deeper than in the model itself"
    assert f"<li>{sentence}: look at the mouth in cam07.</li>" in page
    assert "of an ear" not in page
    assert "<ul>" not in render_report(some_inputs())


def test_corrections_of_cameras_are_shown_the_largest_first():
    row = {"T_cam_world": [], "intrinsics": [], "distortion": [], "focal_factor": 1.0}
    views = {"cam<1>": {**row, "shift_px": 0.4, "sigmas": 0.8}, "cam2": {**row, "shift_px": 1.6, "sigmas": 3.2}}
    warning = "The camera of view cam2 is corrected by 3.2 times the stated sigma: it may have moved."
    figures = {"cameras": {"sigma_px": 0.5, "views": views, "warnings": [warning]}}
    page = render_report(some_inputs(registration=a_registration(figures=figures)))
    check_page(page)
    assert f"<li>{warning}</li>" in page and "the stated sigma is 0.5 px" in page
    first, second = page.index("<span>cam2</span>"), page.index("<span>cam&lt;1&gt;</span>")
    assert first < second and "1.60 px, 3.2 sigma" in page[first:second] and "width:25.0%" in page[second:]
    assert "stated sigma" not in render_report(some_inputs())


def test_the_command_the_paths_and_the_files_are_on_the_page():
    command = "gnmreg register /captures/anna --model '/my models/gnm.npz' --out /out/anna"
    origin = {"command": command, "capture": "/captures/anna", "model": "/my models/gnm.npz"}
    page = render_report(some_inputs(registration=a_registration(provenance=origin)))
    check_page(page)
    assert html.escape(command, quote=True).replace("&#x27;", "&#39;") in page
    assert '<td class="mono">/my models/gnm.npz</td>' in page and '<a href="mesh.ply">mesh.ply</a>' in page


def test_the_colours_of_distances_end_where_a_millimetre_is_not_good():
    row = {"points": 9, "mean_mm": 0.5, "median_mm": 0.4, "std_mm": 0.1, "p95_mm": 0.7}

    def ends_at(**figures) -> str:
        page = render_report(some_inputs(registration=a_registration(figures=figures)))
        return re.search("<span>([0-9.]+) mm and more</span>", page)[1]

    assert ends_at(mesh_to_scan={"face": row}) == "1"
    assert ends_at(mesh_to_scan={"face": {**row, "p95_mm": 30.0}}) == "2"
    assert ends_at() == "0.5"  # of all vertices


def test_one_vertex_is_singular():
    row = {"vertices_beyond_0.3mm": 1, "max_excess_mm": 0.5}
    [line] = remarks(a_registration(figures={"intersections": {"pairs": {"lips in teeth": row}}}))
    assert line == "1 vertex of the lips lies inside the teeth, worst 0.5 mm deeper than in the model itself."


def test_every_pair_of_the_audit_has_words():
    pairs = [pair.name for pair in audit_penetration(TEMPLATE.template_vertex_positions, TEMPLATE).pairs]
    row = {"vertices_beyond_0.3mm": 3, "max_excess_mm": 0.5}
    lines = remarks(a_registration(figures={"intersections": {"pairs": dict.fromkeys(pairs, row)}}))
    assert len(lines) == len(pairs) and not any("another part, worst" in line for line in lines)


def test_the_page_says_how_many_views_of_how_many_it_shows():
    views = tuple(a_view(name=f"cam{number:02}") for number in range(5))
    page = render_report(some_inputs(views=views[:2], thumbnails=views))
    check_page(page)
    assert "Shown are 2 of 5 views" in page and "All 5 views" in page and "cam04" in page
    everything = render_report(some_inputs(views=views, thumbnails=views))
    assert "Shown are" not in everything and "All 5 views" not in everything


def test_a_converged_face_that_is_a_millimetre_wrong_is_not_green():
    row = {"points": 1234, "mean_mm": 1.15, "median_mm": 1.0, "std_mm": 0.2, "p95_mm": 2.5}
    page = render_report(some_inputs(registration=a_registration(figures={"scan_to_mesh": {"face": row}})))
    assert '<span class="badge wrong">wrong</span><span class="status">status: converged</span>' in page
    assert 'class="badge good"' not in page and "1.15 mm from the mesh on average" in page


def test_residuals_are_shown_overall_and_of_the_worst_view():
    views = {"cam00": {"silhouette_px": 0.5, "normals_deg": 2.0}, "cam01": {"silhouette_px": 1.5}}
    figures = {"residuals": residual_figures(views)}
    page = render_report(some_inputs(registration=a_registration(figures=figures)))
    check_page(page)
    rows = re.findall(r"<tr><td>silhouette</td>(.*?)</tr>", page)
    assert len(rows) == 1 and "1.0\N{NO-BREAK SPACE}px" in rows[0] and "<td>cam01</td>" in rows[0]
    assert "silhouette: mean distance of the outlines" in page  # a tile, as there is no scan


def test_hidden_panels_when_stages_do_not_fill_a_row():
    history = {f"stage {k}": {"x": [2.0, 1.0]} for k in range(4)}
    assert loss_curves(history).count("stage ") == 4
