"""``neurad compare``: fits with one budget, and their report: tables, curves, pictures and the page that shows them."""
