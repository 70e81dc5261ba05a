"""What the kernels of sensed models are measured against: other formulas, and simulated trials."""

import numpy as np


def homogeneous(model, sensing, law, gains, xp=np):
    """Yield each step's matrices in z = (x, xhat, 1): the map, its noise's maps, the cost's weight.

    One map and one list of noise's maps say all; nothing of the library's recursions is used.
    """
    T, nx, nu = model.fu.shape
    zero, one = xp.zeros, xp.zeros((1, 2 * nx + 1)) + np.eye(2 * nx + 1)[-1:]
    X = xp.concatenate([np.eye(nx), zero((nx, nx + 1))], axis=1)
    Xhat = xp.concatenate([zero((nx, nx)), np.eye(nx), zero((nx, 1))], axis=1)
    none = zero((nx, 2 * nx + 1))
    for t in range(T):
        U = xp.concatenate([zero((nu, nx)), law.K[t], law.k[t][:, None]], axis=1)
        A, B, G = model.fx[t], model.fu[t], gains[t]

        def rows(noise, t=t, U=U):
            c, cx, cu, *_ = noise
            for i in range(c.shape[1]):
                row = c[t, i][:, None] * one
                row = row if cx is None else row + cx[t, i] @ X
                yield row if cu is None else row + cu[t, i] @ U

        estimate = A @ Xhat + B @ U + G @ sensing.F[t] @ (X - Xhat)
        columns = []
        if model.noise is not None:
            columns += [xp.concatenate([row, none, 0 * one]) for row in rows(model.noise)]
        if sensing.noise is not None:
            columns += [xp.concatenate([none, G @ row, 0 * one]) for row in rows(sensing.noise)]
        if sensing.internal is not None:
            own = (column[:, None] * one for column in sensing.internal[t])
            columns += [xp.concatenate([none, row, 0 * one]) for row in own]
        linear = one.T @ (model.lx[t][None] @ X + model.lu[t][None] @ U)
        cross = U.T @ model.lux[t] @ X
        W = X.T @ model.lxx[t] @ X + U.T @ model.luu[t] @ U + cross + cross.T + linear + linear.T
        yield xp.concatenate([A @ X + B @ U, estimate, one]), columns, W


def exact_cost(model, sensing, law, gains, start, xp=np):
    """Return the sum of tr(W E[zz'])/2 and all E[zz'], carried forward from `start`, the first."""
    nx, moments, total = model.vx.size, [start], 0.0
    for step, columns, W in homogeneous(model, sensing, law, gains, xp):
        Z = moments[-1]
        total = total + 0.5 * xp.sum(W * Z)
        moments.append(sum((C @ Z @ C.T for C in columns), step @ Z @ step.T))
    last = moments[-1]
    total = total + model.vx @ last[:nx, -1] + 0.5 * xp.sum(model.vxx * last[:nx, :nx])
    return total, moments


def second_moments(mean, cov, estimate=None):
    """Return E[zz'] of a start."""
    estimate = mean if estimate is None else estimate
    z = np.concatenate([mean, estimate, [1.0]])
    Z = np.outer(z, z)
    Z[: mean.size, : mean.size] += cov
    return Z


def trials(model, sensing, law, gains, mean, cov, count, seed):
    """Simulate the closed loop; return each trial's cost, and the last states (nx, count)."""
    model, sensing, law, gains = map(as_numpy, (model, sensing, law, gains))
    # A root of a covariance that may be singular.
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0))
    pieces = max(1, count // 10_000)  # which stay in the cache
    parts = [
        _trials(model, sensing, law, gains, mean, root, count // pieces, rng)
        for rng in np.random.default_rng(seed).spawn(pieces)
    ]
    return tuple(np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))


def _trials(model, sensing, law, gains, mean, root, count, rng):
    x = mean[:, None] + root @ rng.standard_normal((mean.size, count))
    xhat = np.repeat(mean[:, None], count, axis=1)
    cost = np.zeros(count)

    def drawn(noise, t, x, u):
        if noise is None:
            return 0.0
        columns, rows = noise.c.shape[1:]
        level = np.repeat(noise.c[t].reshape(-1, 1), count, axis=1)
        for slope, of in ((noise.cx, x), (noise.cu, u)):
            if slope is not None:
                level = level + slope[t].reshape(columns * rows, -1) @ of
        draws = rng.standard_normal((columns, 1, count))
        return np.sum(level.reshape(columns, rows, count) * draws, axis=0)

    def weighed(x, W, y):
        return np.sum((W @ x) * y, axis=0)

    for t in range(model.fx.shape[0]):
        u = law.k[t][:, None] + law.K[t] @ xhat
        cost += model.lx[t] @ x + model.lu[t] @ u + weighed(x, model.lux[t], u)
        cost += 0.5 * (weighed(x, model.lxx[t], x) + weighed(u, model.luu[t], u))
        known = 0 if sensing.E is None else sensing.E[t] @ u
        y = sensing.F[t] @ x + known + drawn(sensing.noise, t, x, u)
        surprise = y - sensing.F[t] @ xhat - known
        xhat = model.fx[t] @ xhat + model.fu[t] @ u + gains[t] @ surprise
        if sensing.internal is not None:
            own = sensing.internal[t].T
            xhat = xhat + own @ rng.standard_normal((own.shape[1], count))
        x = model.fx[t] @ x + model.fu[t] @ u + drawn(model.noise, t, x, u)
    return cost + model.vx @ x + 0.5 * weighed(x, model.vxx, x), x


def as_numpy(tree):
    """Return a tree of NamedTuples with arrays of NumPy."""
    if tree is None:
        return None
    if hasattr(tree, "_fields"):
        return type(tree)(*map(as_numpy, tree))
    return np.asarray(tree)


def kalman_lqg(A, B, C, C0, H, D, D0, E0, Q, R, X1, S1, sweeps=200):
    """Iterate Todorov (2005), eq. 4.2 and 5.2 with his cost, as written: S^x and S^e, no x-hat."""
    n, T = A.shape[0], Q.shape[0] - 1
    covariance = (np.zeros((m, m)) if a is None else a @ a.T for a, m in ((C0, n), (E0, n)))
    omega_x, omega_h = covariance
    omega_y = np.zeros((len(H), len(H))) if D0 is None else D0 @ D0.T
    D = np.zeros((0, *H.shape)) if D is None else D
    K, L, costs = np.zeros((T, n, len(H))), np.zeros((T, B.shape[1], n)), []
    for _ in range(sweeps):
        Se, Sx, Sxe = S1, np.outer(X1, X1), np.zeros((n, n))
        for t in range(T):
            both = Se + Sx + Sxe + Sxe.T
            seen = H @ Se @ H.T + omega_y + sum(d @ both @ d.T for d in D)
            K[t] = A @ Se @ H.T @ np.linalg.pinv(seen)
            closed, BL = A - K[t] @ H, A - B @ L[t]
            effort = L[t] @ Sx @ L[t].T
            after = omega_x + omega_h + closed @ Se @ A.T
            after = after + sum(B @ c @ effort @ c.T @ B.T for c in C)
            cross = BL @ Sxe @ H.T @ K[t].T
            Sx = omega_h + K[t] @ H @ Se @ A.T + BL @ Sx @ BL.T + cross + cross.T
            Se, Sxe = after, BL @ Sxe @ closed.T - omega_h
        Vx, Ve, cost = Q[-1], np.zeros((n, n)), 0.0
        for t in reversed(range(T)):
            closed = A - K[t] @ H
            cost += np.sum(Vx * omega_x)
            cost += np.sum(Ve * (omega_x + omega_h + K[t] @ omega_y @ K[t].T))
            price = R + B.T @ Vx @ B + sum(c.T @ B.T @ (Vx + Ve) @ B @ c for c in C)
            L[t] = np.linalg.solve(price, B.T @ Vx @ A)
            error = A.T @ Vx @ B @ L[t] + closed.T @ Ve @ closed
            Vx = Q[t] + A.T @ Vx @ (A - B @ L[t]) + sum(d.T @ K[t].T @ Ve @ K[t] @ d for d in D)
            Ve = error
        costs.append(X1 @ Vx @ X1 + np.sum((Ve + Vx) * S1) + cost)
    return L, K, np.array(costs)
