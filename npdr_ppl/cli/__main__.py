"""`python -m npdr_ppl.cli`, the same as `npdr`."""

from npdr_ppl.cli.main import main

if __name__ == "__main__":
    main()
