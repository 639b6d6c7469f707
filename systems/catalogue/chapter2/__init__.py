"""Systems of chapter 2 of the book."""
