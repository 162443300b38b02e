from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Kalman and coupled estimators for time-delay laws, and filters of the commanded force",
    page="estimators",
    brings={
        "services": {
            "command_filter": "estimators.filtering:make_filtered",
            "estimator_coupled": "estimators.coupled:CoupledEstimator",
            "estimator_kalman": "estimators.kalman:KalmanEstimator",
        },
    },
)
