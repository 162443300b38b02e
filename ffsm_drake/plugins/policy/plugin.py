from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="A trained policy in an ONNX file as a control law",
    page="trained_policy",
    extras=("policy",),
    needs=("task_space",),
    brings={
        "controller_files": {"policy": "policy.policy:PolicyFile.at"},
    },
)
