"""The commands of docs/service.md, which tests run as they stand."""

import re

from tests.conftest import ROOT

DOCUMENT = ROOT / "docs" / "service.md"


def blocks(section: str) -> str:
    """Return the commands in a section."""
    part = DOCUMENT.read_text("utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    return "\n".join(re.findall(r"```sh\n(.*?)```", part, re.DOTALL))
