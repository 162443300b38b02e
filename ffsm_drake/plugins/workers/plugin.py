from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Processes for many runs: on this machine, or on a Dask cluster",
    page="campaigns_on_a_cluster",
    extras=("cluster",),
)
