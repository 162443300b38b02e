from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Kalman and coupled estimators for time-delay laws, and filters of the commanded force",
    page="estimators",
    brings={
        "estimators": {
            "coupled": "estimators.coupled:CoupledEstimator",
            "kalman": "estimators.kalman:KalmanEstimator",
        },
        "command_filters": {"filters": "estimators.filtering:with_filters"},
    },
)
