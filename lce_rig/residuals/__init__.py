"""What boards say of an extrinsic: plane and ring-end residuals, their derivatives, quadratics by capture."""
