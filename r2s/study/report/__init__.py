"""The report of a study: tables, pictures, videos and one HTML page."""
