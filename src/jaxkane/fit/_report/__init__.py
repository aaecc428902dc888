"""What a fit looks like: tables, text, pictures, a page."""
