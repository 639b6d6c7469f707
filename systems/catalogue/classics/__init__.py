"""Classics of nonholonomic, rigid and linked systems that the book does not have."""
