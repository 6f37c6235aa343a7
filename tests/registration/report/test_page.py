"""The page is complete, well-formed and self-contained, and escapes names."""

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

from registration.report import heat_map as heat_maps
from registration.report.charts import ChartLine, line_charts, loss_curves
from registration.report.inputs import ReportInputs, distance_heat_map
from registration.report.page import headline, render_report
from registration.storage.hashing import versions
from registration.types import Registration
from tests.registration.report.test_pictures import a_view

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
    assert links and all(link.startswith(("data:", "#")) for link in links), "an external resource"
    assert "url(http" not in page and "@import" not in page


def test_a_full_page():
    page = render_report(some_inputs())
    check_page(page)
    for text in ("anna", "smile", "converged", "0.123", "1.46", "cam00", "cam01", "2.0 % excluded by normals"):
        assert text in page, text
    for text in ("subject&#39;s left", "left_eye", "3 min 21 s", "mitsuba", "ab" * 32, "&#34;recipe&#34;"):
        assert text in page, text
    assert page.count("data:image/jpeg") == 3 + 2 * 9
    positions = [page.index(f'id="{name}"') for name in ("distances", "views", "optimization", "provenance")]
    assert positions == sorted(positions)


def test_an_empty_page_has_no_empty_sections():
    empty = {name: {} for name in ("seconds", "history", "figures", "config", "inputs")}
    registration = a_registration(status="failed", reason="no initial guess", **empty)
    page = render_report(some_inputs(registration=registration, views=(), heat_map=None, versions={}))
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
    figures = {
        "notes": ["landmarks 2-6 of scheme 68 do not fit the model's: excluded"],
        "views_not_trusted": {"cam03": "silhouette 35 px off the other views"},
        "intersections": {"pairs": {"tongue in gums": row, "ears in skin": {**row, "vertices_beyond_0.3mm": 0}}},
    }
    page = render_report(some_inputs(registration=a_registration(figures=figures)))
    assert "<li>View cam03 has a low weight: silhouette 35 px off the other views.</li>" in page
    assert "<li>Landmarks 2-6 of scheme 68 do not fit" in page
    assert "<li>Tongue in gums: 2 vertices deeper than in the template, by up to 0.830 mm.</li>" in page
    assert "Ears in skin" not in page
    assert "<ul>" not in render_report(some_inputs())


def test_hidden_panels_when_stages_do_not_fill_a_row():
    history = {f"stage {k}": {"x": [2.0, 1.0]} for k in range(4)}
    assert loss_curves(history).count("stage ") == 4
