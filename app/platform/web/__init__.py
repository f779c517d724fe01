"""What every request and page shares: middleware, API types, forms, templates, charts, static files."""
