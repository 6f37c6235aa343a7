"""Log records of this package and of DBOS: to stderr, printable, without passwords."""

import json
import logging
import os
import sys

from dbos._error import DBOSAwaitedWorkflowCancelledError, DBOSWorkflowCancelledError

from registration.terminal import printable
from workflows.engine.serialization import JobFailed
from workflows.ids import redact

# Errors that say nothing more than the job's row and log do.
_REPORTED = (JobFailed, DBOSWorkflowCancelledError, DBOSAwaitedWorkflowCancelledError)


FORMAT = "GNMREG_LOG_FORMAT"  # an environment variable: "json" for one JSON object a line, from the level info
JSON = "json"


def configure_logging() -> None:
    """Write warnings and errors of our loggers, of DBOS and of uvicorn to stderr as text, and nowhere else.

    With GNMREG_LOG_FORMAT=json also information, one JSON object for each record, with the job's id where there is one.
    """
    as_json = os.environ.get(FORMAT) == JSON
    handler = _StderrHandler()
    plain = logging.Formatter("%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    handler.setFormatter(JsonFormatter() if as_json else plain)
    handler.addFilter(_Redacting())
    for name in ("dbos", "gnmreg", "uvicorn"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.INFO if as_json and name == "gnmreg" else logging.WARNING)


class JsonFormatter(logging.Formatter):
    """One JSON object for each record of a log, with what its `extra` holds."""

    _OWN = frozenset((*vars(logging.makeLogRecord({})), "message", "taskName"))

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        content = {"time": round(record.created, 3), "level": record.levelname.lower(), "logger": record.name}
        content |= {"message": record.getMessage()}
        content |= {key: value for key, value in vars(record).items() if key not in self._OWN}
        if record.exc_text or record.exc_info:
            content["error"] = record.exc_text or self.formatException(record.exc_info)  # type: ignore[arg-type]
        return json.dumps(content, default=str)


class _StderrHandler(logging.Handler):
    """Write to the stream that `sys.stderr` is at that time: one of an earlier command may be closed."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            print(self.format(record), file=sys.stderr, flush=True)
        except Exception:
            self.handleError(record)


class _Redacting(logging.Filter):
    """Removes passwords from URLs in all log records, and the tracebacks of failed and cancelled jobs."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info and isinstance(record.exc_info[1], _REPORTED):
            return False
        record.msg, record.args = printable(redact(record.getMessage())), None
        if record.exc_info:
            record.exc_text = printable(redact(logging.Formatter().formatException(record.exc_info)))
            record.exc_info = None
        return True
