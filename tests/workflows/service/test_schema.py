"""The API against its own description: schemathesis makes requests, valid and not, and no answer is a server error."""

import os
import re
import subprocess
import sys

from tests.workflows.service.conftest import API, open_service

EXAMPLES = 8  # random requests for each operation, besides those that cover its parameters


def test_no_request_causes_a_server_error(tmp_path):
    with open_service(tmp_path / "farm") as service:
        command = [sys.executable, "-m", "schemathesis.cli", "run", f"{service.url}{API}/openapi.json"]
        command += ["--header", f"Authorization: Bearer {both_roles(service)}"]
        command += ["--checks", "not_a_server_error,content_type_conformance,response_schema_conformance"]
        command += ["--phases", "examples,coverage,fuzzing", "--max-examples", str(EXAMPLES), "--seed", "7"]
        command += ["--exclude-path", f"{API}/events", "--generation-database", "none", "--workers", "1"]
        command += ["--request-timeout", "120"]  # the first submission imports the library, in a child process
        environment = {**os.environ, "SCHEMATHESIS_HOOKS": ""}
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
        assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-2000:]}"
        made = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
        assert made and int(made[1]) == int(made[2]) >= 200
        assert service.get("//healthz", role=None).status == 200


def both_roles(service) -> str:
    return service.state.tokens.create("everything", ["operator", "reviewer"])
