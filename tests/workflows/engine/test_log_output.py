import contextlib
import io
import logging

import pytest

from workflows.engine.log_output import configure_logging


def test_records_go_to_the_present_stderr_without_passwords(capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.redirect_stderr(io.StringIO()) as earlier:
        configure_logging()
    earlier.close()  # as after an earlier command in the same process
    for name in ("dbos", "gnmreg"):
        logging.getLogger(name).warning("no answer from %s\x1b[2J", "postgresql://me:canary@host/db")
    error = capsys.readouterr().err
    assert error.count("no answer from postgresql://me:***@host/db\\x1b[2J") == 2
    assert "canary" not in error and "Traceback" not in error
