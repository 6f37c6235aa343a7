"""The environment of all pages, and that wheels carry the templates."""

import tomllib
from fnmatch import fnmatch

import jinja2
import pytest
from markupsafe import Markup

from registration.report.templates import environment
from tests.conftest import ROOT

PACKAGES = ("workflows.pages", "workflows.web")
FOLDERS = ("registration/report/templates", "workflows/pages/templates", "workflows/web/templates")


def test_what_a_template_inserts_is_escaped_unless_it_is_markup():
    template = environment().from_string('{% import "parts.html" as parts %}{{ parts.tiles(rows) }}')
    html = template.render(rows=[("<1>", "m&m", '"x"'), (Markup("<i>2</i>"), "", "")])
    assert "&lt;1&gt; <small>m&amp;m</small>" in html and "&#34;x&#34;" in html and "<b><i>2</i></b>" in html


def test_a_missing_value_is_an_error():
    with pytest.raises(jinja2.UndefinedError):
        environment().from_string("{{ missing }}").render()


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_template_compiles_and_is_package_data(folder):
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["package-data"]
    files = [path for path in (ROOT / folder).iterdir() if path.is_file() and path.suffix != ".py"]
    assert files
    for path in files:
        environment(*PACKAGES).get_template(path.name)
        packaged = [
            (ROOT / package.replace(".", "/") / pattern)
            for package, patterns in settings.items()
            for pattern in patterns
        ]
        assert any(fnmatch(str(path), str(pattern)) for pattern in packaged), path


def test_no_template_turns_escaping_off():
    texts = {path: path.read_text("utf-8") for folder in FOLDERS for path in (ROOT / folder).glob("*.html")}
    assert [path for path, text in texts.items() if "|safe" in text or "autoescape" in text] == []


def test_tables_align_numbers_and_sections_without_content_are_omitted():
    source = """{% import "parts.html" as parts %}{{ parts.table(("name", "count"), rows) }}
{{ parts.sectioned((("First one", "why", "x"), ("Second", "", " "))) }}"""
    html = environment().from_string(source).render(rows=[("a", 1), ("b", 22)])
    assert '<th class="num">count</th>' in html and '<td>b</td><td class="num">22</td>' in html
    assert 'href="#first"' in html and 'id="first"' in html and "second" not in html.lower()
