"""A worker or a coordinator of test steps and flows, in a separate process that can be killed."""

import importlib
import json
import sys
from pathlib import Path

from workflows.engine.jobs import DRIVER, GPU, REBUILD, SUBJECTS
from workflows.engine.liveness import LivenessTimeouts
from workflows.engine.process import EngineProcess, serve

if __name__ == "__main__":
    kind, name, url, folder, settings = sys.argv[1:]
    config = json.loads(settings)
    steps, flows = (importlib.import_module(config[name]) for name in ("steps", "flows"))
    serve(
        EngineProcess(
            url=url,
            queues=(GPU, REBUILD) if kind == "worker" else (DRIVER, SUBJECTS),
            logs=Path(folder) / "logs",
            names=(name,),
            roots=tuple(config.get("roots", {}).get(name, (folder,))),
            steps=steps.STEPS if kind == "worker" else {},
            flows=flows.FLOWS if kind == "coordinator" else {},
            timeouts=LivenessTimeouts(**config["timeouts"]) if config.get("timeouts") else None,
            back_off_s=config.get("back_off_s", 0.2),
        )
    )
