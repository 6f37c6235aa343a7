"""What the documents name exists: links, headings, files, modules, commands and their options, citations."""

import importlib
import re
import shlex
import subprocess
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from tests.conftest import ROOT

DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
PACKAGES = ("registration", "coregister", "workflows", "bench", "tests", "docs")
SUFFIXES = (".py", ".md", ".toml", ".yaml", ".txt", ".jpg", ".png", ".npz", ".json")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def tracked() -> frozenset[str]:
    """Files of the repository, as paths from its root, with all folders that hold one."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    files = [line for line in listed.stdout.splitlines() if (ROOT / line).exists()]
    return frozenset(str(path) for file in files for path in (Path(file), *Path(file).parents) if str(path) != ".")


@cache
def headings(document: Path) -> frozenset[str]:
    """Anchors of a document's headings, as GitHub makes them."""
    text = FENCE.sub("", document.read_text("utf-8"))
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles)


def spans(document: Path) -> Iterator[str]:
    yield from SPAN.findall(FENCE.sub("", document.read_text("utf-8")))


def lines_of_code(document: Path) -> Iterator[str]:
    """Lines of fenced and of indented blocks without a language or in a shell's, and code within the text."""
    text = document.read_text("utf-8")
    for language, block in FENCE.findall(text):
        if language in ("", "sh", "bash", "shell"):
            yield from block.replace("\\\n", " ").splitlines()
    yield from (line.strip() for line in FENCE.sub("", text).splitlines() if line.startswith("    "))
    yield from spans(document)


def commands(program: str) -> Iterator[tuple[Path, list[str]]]:
    """Every use of a program in the documents: the words after its name, without comments."""
    for document in DOCUMENTS:
        for line in lines_of_code(document):
            line = line.split(" #")[0].strip()
            line = re.sub(r"^(\$ |\.venv/bin/|[A-Z_]+=\S+ )+", "", line)
            if line.startswith(f"{program} "):
                plain = line.removeprefix(f"{program} ").replace("...", "").replace("[", " ").replace("]", " ")
                yield document, shlex.split(plain)


@pytest.mark.parametrize("document", DOCUMENTS, ids=relative)
def test_links_lead_somewhere(document):
    broken = []
    for target in LINK.findall(document.read_text("utf-8")):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        file = (document.parent / path).resolve() if path else document
        inside = file.is_relative_to(ROOT) and file.exists()
        if not inside or (anchor and file.suffix == ".md" and anchor not in headings(file)):
            broken.append(target)
    assert broken == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=relative)
def test_paths_in_the_text_exist(document):
    """A path is a whole one from the root, or the end of one if it names a Python file."""
    missing = []
    for span in spans(document):
        path = span.rstrip("/")
        if not re.fullmatch(r"[\w.\-/]+", path):
            continue
        whole = path.split("/")[0] in PACKAGES and "/" in span
        if whole and path not in tracked():
            missing.append(span)
        if path.endswith(".py") and not any(f"/{known}".endswith(f"/{path}") for known in tracked()):
            missing.append(span)
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=relative)
def test_dotted_names_exist(document):
    missing = []
    for span in spans(document):
        match = re.fullmatch(r"((?:registration|coregister|workflows)(?:\.\w+)+)(\(.*\))?", span)
        if match and not resolves(match[1]) and not span.endswith(SUFFIXES):
            missing.append(span)
    assert missing == []


def resolves(dotted: str) -> bool:
    """Whether a name is a module, or an attribute of one."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for name in parts[count:]:
            if not hasattr(found, name) and name not in getattr(found, "__annotations__", {}):
                return False
            found = getattr(found, name, None)
        return True
    return False


@pytest.fixture(scope="module")
def program() -> Callable[[list[str]], int]:
    """The function behind the command `gnmreg`."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]
    module, _, name = scripts["gnmreg"].partition(":")
    function: Callable[[list[str]], int] = getattr(importlib.import_module(module), name)
    return function


def test_every_gnmreg_command_has_the_options_that_documents_give_it(program, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    helps: dict[tuple[str, ...], str] = {}

    def help_of(words: tuple[str, ...]) -> str:
        if words not in helps:
            with pytest.raises(SystemExit):
                program([*words, "--help"])
            printed = capsys.readouterr()
            helps[words] = re.sub(r"\x1b\[[0-9;]*m", "", printed.out + printed.err)
        return helps[words]

    def is_command(words: tuple[str, ...]) -> bool:
        named = re.fullmatch("[a-z][a-z-]*", words[-1]) is not None
        return named and f"usage: gnmreg {' '.join(words)} " in help_of(words)

    wrong = []
    for document, words in commands("gnmreg"):
        command: tuple[str, ...] = ()
        while len(words) > len(command) and is_command((*command, words[len(command)])):
            command = (*command, words[len(command)])
        text = help_of(command)
        unknown = [option for word in words for option in OPTION.findall(word) if option not in OPTION.findall(text)]
        if unknown or not (command or words[0].startswith("--")):
            wrong.append(f"{relative(document)}: gnmreg {' '.join(words)} {unknown}")
    assert len(helps) > 15
    assert wrong == []


def test_every_python_command_names_a_module_or_a_file():
    wrong = []
    for document, words in commands("python"):
        module = words[0] == "-m"
        file = words[1].replace(".", "/") + ".py" if module else words[0]
        package = words[1].replace(".", "/") + "/__main__.py" if module else ""
        ours = not module or words[1].split(".")[0] in PACKAGES
        if ours and words[1] != "bench.NAME" and not {file, package} & tracked():
            wrong.append(f"{relative(document)}: python {' '.join(words)}")
    assert wrong == []
    assert list(commands("python"))


def test_benchmarks_are_started_in_one_way():
    text = {relative(document): document.read_text("utf-8") for document in DOCUMENTS}
    assert [name for name, content in text.items() if re.search(r"python3? bench/", content)] == []


def test_every_make_command_has_a_target():
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    wrong = [(relative(document), words[0]) for document, words in commands("make") if words[0] not in targets]
    assert wrong == []
    assert {words[0] for _, words in commands("make")} >= {"setup", "demo", "test"}


def test_every_page_can_be_reached_from_the_readme():
    seen, queue = set(), [ROOT / "README.md"]
    while queue:
        document = queue.pop()
        if document in seen or document.suffix != ".md":
            continue
        seen.add(document)
        links = [target.partition("#")[0] for target in LINK.findall(document.read_text("utf-8"))]
        paths = [(document.parent / link).resolve() for link in links if link and not link.startswith("http")]
        queue += [file for path in paths for file in ([path] if path.is_file() else path.glob("*.md"))]
    assert [relative(document) for document in DOCUMENTS if document not in seen] == []


def test_every_statement_of_the_paper_has_a_status_and_a_place():
    text = (ROOT / "docs" / "paper.md").read_text("utf-8")
    statements = text[text.index("\n## ") :]
    rows = [line.strip("| ").split(" | ") for line in statements.splitlines() if line.startswith("| ")]
    assert len(rows) > 60 and {len(row) for row in rows} == {3}
    assert {row[1] for row in rows} <= {"status", "implemented", "otherwise", "partly", "missing", "added"}
    there = [row for row in rows if row[1] not in ("status", "missing")]
    assert [row[0] for row in there if not re.search(r"`\w+/[\w/]+|\]\(", row[2])] == []


def test_glossary_is_alphabetic_and_says_each_term_once():
    text = (ROOT / "docs" / "glossary.md").read_text("utf-8")
    terms = [row.split("|")[1].strip().lower() for row in text.splitlines() if row.startswith("| ")][1:]
    assert len(terms) > 50
    assert terms == sorted(set(terms))


def test_ten_minutes_lists_every_room_in_import_order():
    """The list names each package with the folders directly inside it, no other, in the order of the contracts."""
    text = (ROOT / "docs" / "ten_minutes.md").read_text("utf-8")
    (block,) = [block for _, block in FENCE.findall(text) if "registration    " in block]
    listed, package = list[str](), ""
    for line in block.splitlines():
        name = line.split()[0]
        package = package if line.startswith(" ") else name
        listed.append(f"{package}/{name}" if line.startswith(" ") else name)
    rooms = {path.rsplit("/", 1)[0] for path in tracked() if path.endswith("/__init__.py") and path.count("/") <= 2}
    rooms = {room for room in rooms if room.split("/")[0] in ("registration", "coregister", "workflows")}
    assert {name for name in listed if not name.endswith(".py")} == rooms
    assert {name for name in listed if name.endswith(".py")} <= tracked()
    position = {name.removesuffix(".py"): number for number, name in enumerate(listed)}
    for name, layers in import_layers().items():
        listed_layers = [[position[room] for room in layer if room in position] for layer in layers]
        listed_layers = [layer for layer in listed_layers if layer]
        assert all(max(upper) < min(lower) for upper, lower in pairwise(listed_layers)), name


def import_layers() -> dict[str, list[list[str]]]:
    """The layers of each import contract, from the top, as paths from the root without a suffix."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    layers = {}
    for contract in contracts:
        if contract["type"] == "layers":
            prefixes = [f"{container}/" for container in contract.get("containers", [])] or [""]
            rooms = [[room.strip() for room in layer.split("|")] for layer in contract["layers"]]
            layers[contract["name"]] = [[prefix + room for prefix in prefixes for room in layer] for layer in rooms]
    return layers


def sources() -> dict[str, str]:
    """Documents and Python files, with all white space and comment signs as one blank."""
    files = [ROOT / name for name in tracked() if name.startswith(PACKAGES) and name.endswith(".py")]
    texts = {relative(file): file.read_text("utf-8") for file in (*DOCUMENTS, *files) if file != Path(__file__)}
    return {name: re.sub(r"\s+(?:# )?", " ", text) for name, text in texts.items()}


def test_citations_resolve():
    references = (ROOT / "docs" / "references.md").read_text("utf-8")
    keys = set(re.findall(r"^(?:- )?\*\*\[([^\]]+)\]\*\*", references, re.MULTILINE))
    titles = set(re.findall(r"^\| ([^|]+?) \|", references, re.MULTILINE))
    sections = re.findall(r"^## (.+)$", (ROOT / "docs" / "algorithms.md").read_text("utf-8"), re.MULTILINE)
    wrong = []
    for name, text in sources().items():
        cited = re.findall(r"\[GNM, ([^\];*]+)", text)
        wrong += [(name, title) for title in cited if title not in titles | {"section title"}]
        chosen = re.findall(r'docs/algorithms\.md, "([^"]+)"', text)
        wrong += [(name, title) for title in chosen if title not in sections]
        named = re.findall(r"\[((?:van )?[A-Z][\wåü]+ (?:et al\. )?(?:19|20)\d\d)\]", text)
        wrong += [(name, key) for key in named if key not in keys]
    assert {"GNM", "Nicolet 2021"} <= keys
    assert "Head Identity" in titles
    assert wrong == []
