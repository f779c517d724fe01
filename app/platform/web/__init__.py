"""Common part of every request and page: middleware, API types, forms, templates, charts, static files."""
