"""A folder of bags: found, answered one by one or many at a time, kept in one table."""
