"""Pages that join phases; the only room that may import all of them."""
