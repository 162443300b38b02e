from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Checks of the theory on a recorded run, for any controller",
    page="findings",
    brings={
        "commands": {"analyze": "analysis.command:analyze"},
        "verbs": {"analyze": "analysis:analyze"},
        "report_sections": {"findings": "analysis.page:findings_section"},
    },
)
