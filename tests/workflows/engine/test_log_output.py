import contextlib
import io
import json
import logging

import pytest

from workflows.engine.log_output import FORMAT, configure_logging


def test_records_go_to_the_present_stderr_without_passwords(capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.redirect_stderr(io.StringIO()) as earlier:
        configure_logging()
    earlier.close()  # as after an earlier command in the same process
    for name in ("dbos", "gnmreg"):
        logging.getLogger(name).warning("no answer from %s\x1b[2J", "postgresql://me:canary@host/db")
    error = capsys.readouterr().err
    assert error.count("no answer from postgresql://me:***@host/db\\x1b[2J") == 2
    assert "canary" not in error and "Traceback" not in error


def test_records_as_json_name_the_job(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FORMAT, "json")
    configure_logging()
    try:
        raise ValueError("postgresql://me:canary@host/db")
    except ValueError:
        logging.getLogger("gnmreg").info("job ends", extra={"job": "run/ann", "seconds": 1.5}, exc_info=True)
    line = capsys.readouterr().err
    record = json.loads(line)
    assert record["message"] == "job ends" and record["job"] == "run/ann" and record["seconds"] == 1.5
    assert "ValueError" in record["error"] and "canary" not in line
    monkeypatch.delenv(FORMAT)
    configure_logging()
