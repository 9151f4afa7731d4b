"""Mathematical solvers: poses from points, planes and corners, with covariance and certificates."""
