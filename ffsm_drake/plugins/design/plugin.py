from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Stability and margins of the sampled loop, the verdict before a run, design of gains",
    page="verdict",
    needs=("actuators", "capture", "estimators", "flexible"),
    uses=("compiled",),
    brings={
        "commands": {
            "design": "design.command:design",
            "stability": "design.command:stability",
        },
        "verbs": {
            "design": "design.gains:design",
            "stability": "design.stability:stability",
        },
        "services": {
            "advice": "design.verdict:helpful_remarks",
            "layer_remarks": "design.layers:layer_remarks",
            "lqg_limit": "design.limit:find_limit",
            "mission": "design.verdict:mission",
            "plan_remarks": "design.remarks:plan_remarks",
            "remedy": "design.remedy_file:write_remedy",
            "verdict": "design.verdict:verdict",
        },
        "report_sections": {"stability": "design.panels:stability_section"},
    },
)
