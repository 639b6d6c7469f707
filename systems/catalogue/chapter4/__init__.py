"""Systems of chapter 4 of the book."""
