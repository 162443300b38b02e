"""``python -m ffsm_drake`` is ``ffsm``."""

from ffsm_drake.cli import main

if __name__ == "__main__":
    main(prog_name="ffsm")
