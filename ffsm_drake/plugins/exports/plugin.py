from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Export of runs as CSV, MAT, MCAP, CCSDS or Parquet",
    page="interfaces",
    extras=("mcap", "parquet", "ros2"),
    uses=("flight",),
    brings={
        "commands": {"export": "exports.command:export"},
        "verbs": {"export": "exports.export:export"},
        "exporters": {
            "aem": "exports.ccsds:write_aem",
            "csv": "exports.tables:write_csv",
            "mat": "exports.tables:write_mat",
            "mcap": "exports.mcap:write",
            "oem": "exports.ccsds:write_oem",
            "parquet": "exports.tables:write_parquet",
        },
    },
)
