"""The paper's four control laws."""
