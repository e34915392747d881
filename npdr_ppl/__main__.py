"""``python -m npdr_ppl`` is the same as ``npdr``."""

from npdr_ppl.cli.main import run

if __name__ == "__main__":
    run()
