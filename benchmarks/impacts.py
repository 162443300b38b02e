"""A spinning target struck by two arms in turn, with admittance and without.

    python benchmarks/impacts.py

The figures of ``docs/capture.md``.
"""

import numpy as np

from ffsm_drake.plugins.impacts.strikes import Admittance, Strikes, run


def main() -> None:
    """Print the contacts of each run."""
    for name, admittance in (("admittance", Admittance()), ("none", None)):
        found = run(Strikes(admittance=admittance, duration=6.0))
        print(f"{name}: largest contact force {found.force.max():.2f} N")
        for begin, end, spin in found.strikes:
            peak = found.force[(found.time >= begin) & (found.time <= end)].max()
            print(f"  {begin:.3f} to {end:.3f} s: {peak:.2f} N, then {spin:.3f} rad/s")
        drift = np.abs(found.momentum - found.momentum[0]).max(axis=0)
        speed = np.linalg.norm(found.v[-1, 9:11])
        print(f"  momentum to {drift[:2].max():.1e} N s and {drift[2]:.1e} N m s;", end=" ")
        torque = np.abs(found.torque).max()
        print(f"target at the end {speed:.4f} m/s; largest torque {torque:.1f} N m")


if __name__ == "__main__":
    main()
