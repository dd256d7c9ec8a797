"""`python -m echelon` is the command line."""

from echelon.apps.cli.app import main

if __name__ == "__main__":
    main()
