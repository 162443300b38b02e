from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Stability and margins of the sampled loop, the verdict before a run, design of gains",
    page="verdict",
    needs=("actuators", "capture", "estimators", "flexible"),
    uses=("barriers", "compiled", "two_arms"),
    brings={
        "commands": {
            "design": "design.command:design",
            "stability": "design.command:stability",
        },
        "verbs": {
            "design": "design.gains:design",
            "stability": "design.stability:stability",
        },
        "judges": {"design": "design.judge:JUDGE"},
        "report_sections": {"stability": "design.panels:stability_section"},
    },
)
