from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="The report of one or several runs, as one HTML page to open from disk or to send",
    page="quickstart",
    uses=("analysis", "capture", "design"),
    brings={
        "reports": {"report": "report.page:write_report"},
    },
)
