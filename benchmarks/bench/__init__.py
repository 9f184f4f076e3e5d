"""``neurad bench``: one file a benchmark."""
