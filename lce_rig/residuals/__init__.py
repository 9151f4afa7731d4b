"""What boards say of extrinsics: plane and ring-end residuals, their derivatives, quadratics by capture."""
