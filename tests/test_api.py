"""The public names of the packages: the complete list, lazy loading, and documentation of each."""

import dataclasses
import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

import coregister
import registration
from registration.lazy_imports import _imported_names
from tests.registration.register import synthetic

DOCUMENT = Path(__file__).parents[1] / "docs" / "python.md"
REGISTRATION = """
Camera Capture CaptureReport FitOptions GNM GNMData InputError LandmarkFit Lengths Observations OffsetRegion Parameters
Rate Recipe RegisterOptions Registration RegistrationEvaluation Stage View Weights check_capture console_progress
evaluate_registration fit_landmarks load_model load_recipe
load_registration read_capture register save_registration
""".split()
COREGISTER = """
BuiltModel EvaluationSettings HeldOutSubject ModelEvaluation ModelRecipe StoppingRule TrainingMesh TrainingSubject
bootstrap build_model evaluate_models load_model_recipe
""".split()
NAMES = [(registration, name) for name in REGISTRATION] + [(coregister, name) for name in COREGISTER]


def test_the_list_of_public_names() -> None:
    """A removed or added name is a change for users: change this list with it, and the list in docs/python.md."""
    assert REGISTRATION == registration.__all__ == sorted(_imported_names(Path(registration.__file__)))
    assert COREGISTER == coregister.__all__ == sorted(_imported_names(Path(coregister.__file__)))
    table = DOCUMENT.read_text()[DOCUMENT.read_text().index("## Names") :]
    documented = re.findall(r"`(\w+)`", table.replace("| `registration` |", "").replace("| `coregister` |", ""))
    assert sorted(documented) == sorted(REGISTRATION + COREGISTER)


@pytest.mark.parametrize(("package", "name"), NAMES, ids=lambda value: getattr(value, "__name__", value))
def test_every_name_resolves_and_is_documented(package, name: str) -> None:
    item = getattr(package, name)
    document = inspect.getdoc(item)
    generated = dataclasses.is_dataclass(item) and document.startswith(f"{item.__name__}(")
    assert document and not generated and len(document.splitlines()[0]) <= 120
    assert name in dir(package)
    if not inspect.isfunction(item):
        return
    parameters = inspect.signature(item).parameters
    if parameters:
        assert "Args:" in document, f"{name} says nothing about its parameters"
        arguments = document[document.index("Args:") :]
        for parameter in parameters:
            assert re.search(rf"^\s+{parameter}:", arguments, re.MULTILINE), f"{name} does not explain {parameter}"
    returned = get_type_hints(item)["return"]
    if returned is not type(None):
        summary = document.split()[0]
        assert "Returns:" in document or summary in ("Return", "Read", "Yield"), f"{name} does not say what it returns"


def test_unknown_names_are_attribute_errors() -> None:
    for package in (registration, coregister):
        with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'nothing'"):
            _ = package.nothing


def test_importing_the_packages_loads_nothing_heavy() -> None:
    code = "import sys, registration, coregister, registration.options; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"torch", "numpy", "mitsuba", "drjit", "scipy", "cv2", "pycolmap"} & set(loaded)


def test_a_function_of_a_modules_name_stays_a_function() -> None:
    """Imported submodules become attributes of their package: none may have the name of a public function."""
    code = """
import registration.pipeline, registration.evaluate.evaluation, coregister.next_model.build
import registration, coregister
for package in (registration, coregister):
    for name in package.__all__:
        getattr(package, name)
assert callable(registration.register)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    for package in (registration, coregister):
        modules = {path.stem for path in Path(package.__file__).parent.iterdir()}
        assert not modules & set(package.__all__)


def test_the_examples_of_the_document_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    synthetic.make(tmp_path / "capture")
    (tmp_path / "gnm_head.npz").symlink_to(synthetic.MODEL)
    for scheme in synthetic.MODEL.parent.glob("head_sparse_*.txt"):
        (tmp_path / scheme.name).symlink_to(scheme)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert len(blocks) == 3
    for block in blocks:
        exec(compile(block, str(DOCUMENT), "exec"), names)
    status, shape, _, distance, fitted = capsys.readouterr().out.splitlines()
    assert status.startswith("converged") and shape.startswith("(") and (tmp_path / "registered/report.html").is_file()
    assert float(distance.split()[0]) < 1.0
    assert names["longer"].stages[0].steps == 200
    assert fitted.startswith("converged") and names["sigma_mm"].shape == names["vertices"].shape
