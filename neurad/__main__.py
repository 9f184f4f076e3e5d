"""``python -m neurad``."""

from neurad.cli import main

if __name__ == "__main__":
    main()
