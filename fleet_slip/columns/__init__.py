"""One language for what a column is: operations on whole numbers, and what is lowered to them."""
