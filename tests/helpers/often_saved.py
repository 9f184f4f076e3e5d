"""``neurad`` with a checkpoint every 0.2 seconds, in a file of its own: other processes of a fit start it again."""

from neurad.callbacks import checkpoint
from neurad.cli import main

if __name__ == "__main__":
    checkpoint.EVERY_SECONDS = 0.2
    main()
