"""Tables as a program that is not neurad reads them."""

import csv
from pathlib import Path


def csv_rows(path):
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))
