"""What is kept: jobs, levels, events, lens tables, pictures (SQLite by default), and the formats of a lens table.

:class:`storage.repository.Repository` is the door to the database, :data:`storage.exports.EXPORTS` to the formats.
"""
