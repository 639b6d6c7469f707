"""Systems of chapter 3 of the book."""
