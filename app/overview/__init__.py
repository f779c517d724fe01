"""Pages that join phases; with tablet and simulation the only package that may import all of them."""
