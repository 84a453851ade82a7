"""Entry point of `python -m splatax`, which works where the command is not on the path."""

from splatax.cli import main

if __name__ == "__main__":
    main()
