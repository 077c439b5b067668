"""The database behind the library: tables, connections, migrations."""
