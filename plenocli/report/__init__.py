"""Pictures and pages: what a person looks at after a run. Reads what stages read, draws with matplotlib, writes nothing."""
