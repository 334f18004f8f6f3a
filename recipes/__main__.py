"""The command line: ``python -m recipes``."""

from .cli.main import main

if __name__ == "__main__":
    main()
