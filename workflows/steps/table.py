"""The steps that workers may be asked to run. Their names are stored in queues: a name stays, functions may move."""

from collections.abc import Mapping

from workflows.engine.jobs import Step

REGISTER, REGISTER_STORED, COLLECT = "register", "register stored", "collect"
HOLD_OUT, STABILIZE, BUILD, EVALUATE, END_ROUND = "hold out", "stabilize", "build", "evaluate", "end round"
GATE = "gate"

STEPS: Mapping[str, Step] = {
    REGISTER_STORED: Step(
        function="workflows.steps.register:register_stored", path_arguments=("capture", "model", "store")
    ),
    REGISTER: Step(
        function="workflows.steps.register:register_capture",
        path_arguments=("capture", "model", "out", "neutral", "subject_dir"),
    ),
    COLLECT: Step(function="workflows.steps.subject:collect_subject", path_arguments=("subject_dir", "model", "out")),
    HOLD_OUT: Step(
        function="workflows.steps.hold_out:hold_out", path_arguments=("dataset", "registrations", "model", "out")
    ),
    GATE: Step(function="workflows.steps.gate:gate_registrations", path_arguments=("run", "decisions", "out")),
    STABILIZE: Step(
        function="workflows.steps.stabilize:stabilize_subjects", path_arguments=("run", "model", "out", "gate")
    ),
    BUILD: Step(
        function="workflows.steps.build:build_next_model",
        path_arguments=("run", "made", "dataset", "previous", "out"),
    ),
    EVALUATE: Step(function="workflows.steps.evaluate:evaluate_round", path_arguments=("models", "held_out", "out")),
    END_ROUND: Step(function="workflows.steps.round:end_round", path_arguments=("plan",)),
}
