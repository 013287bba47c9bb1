"""The whole path in one go, live on a graph: record, decide, select, train and drive."""
