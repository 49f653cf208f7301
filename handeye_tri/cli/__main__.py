"""``python -m handeye_tri.cli``."""

from handeye_tri.cli import main

if __name__ == "__main__":
    main()
