"""A fit told: tables, text, pictures, a page."""
