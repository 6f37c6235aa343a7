"""Log records of this package and of DBOS: to stderr, printable, without passwords."""

import logging
import sys

from dbos._error import DBOSAwaitedWorkflowCancelledError, DBOSWorkflowCancelledError

from registration.terminal import printable
from workflows.engine.serialization import JobFailed
from workflows.ids import redact

# Errors that say nothing more than the job's row and log do.
_REPORTED = (JobFailed, DBOSWorkflowCancelledError, DBOSAwaitedWorkflowCancelledError)


def configure_logging() -> None:
    """Write warnings and errors of the loggers "dbos" and "gnmreg" to stderr, and nowhere else."""
    handler = _StderrHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S"))
    handler.addFilter(_Redacting())
    for name in ("dbos", "gnmreg"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.WARNING)


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
