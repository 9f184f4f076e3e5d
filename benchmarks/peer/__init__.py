"""The peer in ``neurad bench peer``: the same inverse problem in Mitsuba 3, by path replay backpropagation."""
