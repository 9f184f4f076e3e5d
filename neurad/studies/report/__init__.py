"""The report of a comparison: tables, curves, pictures and the page that shows them."""
