"""A worker or coordinator for bench/farm_queue.py, whose jobs do nothing."""

import sys
from pathlib import Path

from workflows.engine.jobs import DRIVER, GPU, SUBJECTS, Step
from workflows.engine.process import EngineProcess, serve
from workflows.farm.flows import FLOWS


def nothing(**arguments: object) -> None:
    """Do nothing: the step of every job of the benchmark."""


if __name__ == "__main__":
    kind, url, folder, name = sys.argv[1:]
    serve(
        EngineProcess(
            url=url,
            queues=(GPU,) if kind == "worker" else (DRIVER, SUBJECTS),
            logs=Path(folder) / "logs",
            names=(name,),
            steps={"nothing": Step(function="bench.support.farm_queue_process:nothing")} if kind == "worker" else {},
            flows=FLOWS if kind == "coordinator" else {},
        )
    )
