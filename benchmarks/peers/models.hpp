// The dynamics of cases.py, discretised by explicit Euler, with analytic Jacobians.
//
// A model keeps in a Cache what `step` computed and `linearize` can use again. `prepare` writes
// the entries of A = dx'/dx and B = dx'/du that never change; `linearize` writes all others.

#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <string>

namespace peers {

using Eigen::Array;
using Eigen::Matrix;

template <int n>
using Vector = Matrix<double, n, 1>;

// L D L' = M for a small matrix of which only the lower triangle is read. Without square roots.
template <int n>
struct Ldl {
  double lower[n][n], inverse[n];

  // Return whether M is positive definite. `entry(i, j)` is asked for j <= i.
  template <class Entry>
  bool factor(const Entry& entry) {
    bool positive = true;
#pragma GCC unroll 16
    for (int j = 0; j < n; ++j) {
      double pivot = entry(j, j);
#pragma GCC unroll 16
      for (int k = 0; k < j; ++k) pivot -= lower[j][k] * unscaled_[j][k];
      positive &= pivot > 0;
      inverse[j] = 1 / pivot;
#pragma GCC unroll 16
      for (int i = j + 1; i < n; ++i) {
        double e = entry(i, j);
#pragma GCC unroll 16
        for (int k = 0; k < j; ++k) e -= unscaled_[i][k] * lower[j][k];
        unscaled_[i][j] = e;
        lower[i][j] = e * inverse[j];
      }
    }
    return positive;
  }

  // Solve M X = Y in place; `row(i)` is the i-th row of Y.
  template <class Rows>
  void solve(Rows&& row) const {
#pragma GCC unroll 16
    for (int i = 1; i < n; ++i)
#pragma GCC unroll 16
      for (int k = 0; k < i; ++k) row(i) -= lower[i][k] * row(k);
#pragma GCC unroll 16
    for (int i = n - 1; i >= 0; --i) {
      row(i) *= inverse[i];
#pragma GCC unroll 16
      for (int k = i + 1; k < n; ++k) row(i) -= lower[k][i] * row(k);
    }
  }

 private:
  double unscaled_[n][n];
};

struct Pendulum {
  static constexpr int nx = 2, nu = 1;
  using X = Vector<nx>;
  using U = Vector<nu>;
  struct Cache {};

  double dt;

  X step(const X& x, const U& u, Cache&) const {
    return {x[0] + dt * x[1], x[1] + dt * (9.8 * std::sin(x[0]) - 0.01 * x[1] + u[0])};
  }

  template <class A, class B>
  void prepare(A&& a, B&& b) const {
    a(0, 0) = 1, a(0, 1) = dt, a(1, 1) = 1 - 0.01 * dt;
    b(0, 0) = 0, b(1, 0) = dt;
  }

  template <class A, class B>
  void linearize(const X& x, const U&, const Cache&, A&& a, B&&) const {
    a(1, 0) = 9.8 * dt * std::cos(x[0]);
  }
};

// The rigid two-link arm: M(q) ddq = torque + h(q, dq).
struct TwoLinks {
  static constexpr double m2 = 1.0, l1 = 0.30, s2 = 0.16, upper = 0.025, fore = 0.045;
  static constexpr double d1 = upper + fore + m2 * l1 * l1, d2 = m2 * l1 * s2, d3 = fore;

  double c, s, i11, i12, i22, ddq[2];  // i: the inverse of M

  template <class X>
  void accelerate(const X& x, double torque1, double torque2) {
    const double elbow = x[1];
    c = std::cos(elbow), s = std::sin(elbow);
    const double m11 = d1 + 2 * d2 * c, m12 = d3 + d2 * c;
    const double scale = 1 / (m11 * d3 - m12 * m12), w0 = x[2], w1 = x[3];
    i11 = d3 * scale, i12 = -m12 * scale, i22 = m11 * scale;
    const double n1 = torque1 + d2 * s * w1 * (2 * w0 + w1) - 0.05 * w0 - 0.025 * w1;
    const double n2 = torque2 - d2 * s * w0 * w0 - 0.025 * w0 - 0.05 * w1;
    ddq[0] = i11 * n1 + i12 * n2, ddq[1] = i12 * n1 + i22 * n2;
  }

  // Write dt * inv(M) (y1, y2) in column j of rows 2 and 3.
  template <class A>
  void column(A&& a, int j, double dt, double y1, double y2) const {
    a(2, j) = dt * (i11 * y1 + i12 * y2), a(3, j) = dt * (i12 * y1 + i22 * y2);
  }

  // Write rows 2 and 3 of the first four columns; t.. are the torques' own derivatives, which are
  // symmetric in the joints: t_jk = dtorque_j/dq_k, s_jk = dtorque_j/ddq_k.
  template <class X, class A>
  void linearize(const X& x, double dt, A&& a, double t11 = 0, double t12 = 0, double t22 = 0,
                 double s11 = 0, double s12 = 0, double s22 = 0) const {
    const double w0 = x[2], w1 = x[3], k = d2 * s;
    column(a, 0, dt, t11, t12);
    column(a, 1, dt, t12 + d2 * c * w1 * (2 * w0 + w1) + k * (2 * ddq[0] + ddq[1]),
           t22 - d2 * c * w0 * w0 + k * ddq[0]);
    column(a, 2, dt, s11 + 2 * k * w1 - 0.05, s12 - 2 * k * w0 - 0.025);
    column(a, 3, dt, s12 + 2 * k * (w0 + w1) - 0.025, s22 - 0.05);
    a(2, 2) += 1, a(3, 3) += 1;
  }
};

struct TorqueArm {
  static constexpr int nx = 4, nu = 2;
  using X = Vector<nx>;
  using U = Vector<nu>;
  using Cache = TwoLinks;

  double dt;

  X step(const X& x, const U& u, Cache& cache) const {
    cache.accelerate(x, u[0], u[1]);
    return {x[0] + dt * x[2], x[1] + dt * x[3], x[2] + dt * cache.ddq[0], x[3] + dt * cache.ddq[1]};
  }

  template <class A, class B>
  void prepare(A&& a, B&& b) const {
    a.setIdentity(), b.setZero();
    a(0, 2) = a(1, 3) = dt;
  }

  template <class A, class B>
  void linearize(const X& x, const U&, const Cache& cache, A&& a, B&& b) const {
    cache.linearize(x, dt, a);
    cache.column(b, 0, dt, 1, 0), cache.column(b, 1, dt, 0, 1);
  }
};

// The arm with six muscles. Their curves are evaluated side by side in eight lanes, two of them
// idle, with Eigen's vectorised exp and log.
struct MuscleArm {
  static constexpr int nx = 10, nu = 6, lanes = 8;
  using X = Vector<nx>;
  using U = Vector<nu>;
  using Lanes = Array<double, lanes, 1>;
  struct Cache {
    TwoLinks arm;
    Lanes a, l, inverse_l, v, one_minus_th2, exponent, log_ratio, g, exp_g;
    Lanes power, z, y, y_power, fl, under, fv, passive, curve;
  };

  double dt;
  Lanes arm1, arm2, force1, force2, slope1, slope2;  // moment arms, times peak force, over length

  explicit MuscleArm(double step_length) : dt(step_length) {
    const double cm1[6] = {4, -4, 0, 0, 2.8, -3.5}, cm2[6] = {0, 0, 2.5, -2.5, 2.8, -3};
    const double pcsa[6] = {18, 22, 14, 18, 10, 12}, cm[6] = {16, 16, 10, 10, 20, 22};
    arm1.setZero(), arm2.setZero(), force1.setZero(), force2.setZero();
    slope1.setZero(), slope2.setZero();
    for (int i = 0; i < 6; ++i) {
      const double peak = 31.8 * pcsa[i], length = cm[i] * 1e-2;
      arm1[i] = cm1[i] * 1e-2, arm2[i] = cm2[i] * 1e-2;
      force1[i] = arm1[i] * peak, force2[i] = arm2[i] * peak;
      slope1[i] = -arm1[i] / length, slope2[i] = -arm2[i] / length;
    }
  }

  X step(const X& x, const U& u, Cache& m) const {
    Lanes raw = slope1 * (x[0] - 0.8) + slope2 * (x[1] - 1.35);
    // tanh(y) = 1 - 2 / (exp(2 y) + 1)
    const Lanes th = 1 - 2 / ((8 * raw).exp() + 1);
    m.one_minus_th2 = 1 - th.square();
    const Lanes l = 1 + 0.25 * th;
    m.l = l;
    const Lanes v = slope1 * x[2] + slope2 * x[3];
    m.v = v;
    Lanes a = Lanes::Constant(0.5);
    a.head<6>() = x.template tail<6>().array();
    a = a.max(1e-6);
    m.a = a;
    // The exponent is 4.16 / l - 2.05.
    const Lanes numerator = 4.16 - 2.05 * l, joint = 1 / (l * numerator);
    m.inverse_l = numerator * joint;
    m.exponent = numerator * m.inverse_l;
    m.log_ratio = (a * l.square() * joint * (1 / 0.56)).log();
    m.g = (m.exponent * m.log_ratio).exp();
    m.exp_g = (-m.g).exp();
    m.power = (1.93 * l.log()).exp();
    m.z = (m.power - 1) * (1 / 1.03);
    m.y = m.z.square() + 1e-6;
    m.y_power = (0.935 * m.y.log()).exp();
    m.fl = (-m.y_power).exp();
    // Shortening and lengthening differ in both the numerator and the denominator.
    const Lanes top = (v > 0).select(0.62 - (-3.12 + 4.21 * l - 2.67 * l.square()) * v, -5.72 - v);
    m.under = 1 / (v > 0).select(0.62 + v, -5.72 + (1.38 + 2.09 * l) * v);
    m.fv = top * m.under;
    m.passive = 0.02 * (13.8 - 18.7 * l).exp();
    m.curve = m.fl * m.fv - m.passive;
    const Lanes tension = (1 - m.exp_g) * m.curve;
    m.arm.accelerate(x, (force1 * tension).sum(), (force2 * tension).sum());
    X next;
    next[0] = x[0] + dt * x[2], next[1] = x[1] + dt * x[3];
    next[2] = x[2] + dt * m.arm.ddq[0], next[3] = x[3] + dt * m.arm.ddq[1];
    for (int i = 0; i < 6; ++i) {
      const double time = u[i] > x[4 + i] ? 0.066 - 0.016 * u[i] : 0.066;
      next[4 + i] = x[4 + i] + dt * (u[i] - x[4 + i]) / time;
    }
    return next;
  }

  template <class A, class B>
  void prepare(A&& a, B&& b) const {
    a.setIdentity(), b.setZero();
    a(0, 2) = a(1, 3) = dt;
  }

  template <class A, class B>
  void linearize(const X& x, const U& u, const Cache& m, A&& a, B&& b) const {
    const Lanes l = m.l, v = m.v, inverse = m.inverse_l, under = m.under;
    const Lanes active = 1 - m.exp_g, rise = m.exp_g * m.g;
    const Lanes active_l = rise * (1 - m.log_ratio) * 4.16 * inverse.square();
    const Lanes fl_y = -0.935 * m.fl * m.y_power / m.y;
    const Lanes fl_l = fl_y * 2 * m.z * m.power * inverse * (1.93 / 1.03);
    const Lanes c = 1.38 + 2.09 * l, k = -3.12 + 4.21 * l - 2.67 * l.square();
    const Lanes fv_v = (v > 0).select(-0.62 * (k + 1), 5.72 * (1 + c)) * under.square();
    const Lanes fv_l = (v > 0).select((5.34 * l - 4.21) * v, 2.09 * v * (5.72 + v) * under) * under;
    const Lanes t_l = active_l * m.curve + active * (fl_l * m.fv + m.fl * fv_l + 18.7 * m.passive);
    const Lanes t_q = t_l * m.one_minus_th2, t_v = active * m.fl * fv_v;
    const Lanes f11 = force1 * slope1, f12 = force1 * slope2, f22 = force2 * slope2;
    m.arm.linearize(x, dt, a, (f11 * t_q).sum(), (f12 * t_q).sum(), (f22 * t_q).sum(),
                    (f11 * t_v).sum(), (f12 * t_v).sum(), (f22 * t_v).sum());
    const Lanes t_a = (m.a > 1e-6).select(rise * m.exponent / m.a * m.curve, 0.0) * dt;
    const Lanes row2 = t_a * (m.arm.i11 * force1 + m.arm.i12 * force2);
    const Lanes row3 = t_a * (m.arm.i12 * force1 + m.arm.i22 * force2);
    for (int i = 0; i < 6; ++i) {
      a(2, 4 + i) = row2[i], a(3, 4 + i) = row3[i];
      const bool up = u[i] > x[4 + i];
      const double rate = 1 / (up ? 0.066 - 0.016 * u[i] : 0.066);
      a(4 + i, 4 + i) = 1 - dt * rate;
      b(4 + i, i) = dt * (rate + (up ? 0.016 * (u[i] - x[4 + i]) * rate * rate : 0.0));
    }
  }
};

// A chain of n links in absolute angles p with rates w: M(p) ddp = net(p, w, u).
template <int n>
struct Chain {
  static constexpr int nx = 2 * n, nu = n;
  static constexpr double damping = 0.005;
  using X = Vector<nx>;
  using U = Vector<nu>;
  using Square = Matrix<double, n, n, Eigen::RowMajor>;
  struct Cache {
    Square cosines, sines;  // of the differences of angles, times the inertias
    Ldl<n> mass;
    Vector<n> ddp;
  };

  double dt;
  Square heavier;

  explicit Chain(double step_length) : dt(step_length) {
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) heavier(i, j) = 2.0 / n * (n - std::max(i, j)) / (n * n);
  }

  X step(const X& x, const U& u, Cache& m) const {
    const Vector<n> p = x.template head<n>(), w = x.template tail<n>();
    Vector<n> c, s;
    for (int i = 0; i < n; ++i) c[i] = std::cos(p[i]), s[i] = std::sin(p[i]);
    for (int i = 0; i < n; ++i) {
      m.cosines.row(i) = heavier.row(i).cwiseProduct((c[i] * c + s[i] * s).transpose());
      m.sines.row(i) = heavier.row(i).cwiseProduct((s[i] * c - c[i] * s).transpose());
    }
    Vector<n> net = -m.sines.lazyProduct(w.cwiseAbs2());
    double joint = u[0] - damping * w[0];
    for (int i = 0; i < n; ++i) {
      const double next = i + 1 < n ? u[i + 1] - damping * (w[i + 1] - w[i]) : 0.0;
      net[i] += joint - next;
      joint = next;
    }
    m.mass.factor([&](int i, int j) { return m.cosines(i, j); });
    m.mass.solve([&](int i) -> double& { return net[i]; });
    m.ddp = net;
    X following;
    following.template head<n>() = p + dt * w;
    following.template tail<n>() = w + dt * net;
    return following;
  }

  template <class A, class B>
  void prepare(A&& a, B&& b) const {
    a.setIdentity(), b.setZero();
    for (int i = 0; i < n; ++i) a(i, n + i) = dt;
  }

  template <class A, class B>
  void linearize(const X& x, const U&, const Cache& m, A&& a, B&& b) const {
    // The derivatives of net - M ddp at fixed ddp by p, w and u, then inv(M) times them.
    const Vector<n> w = x.template tail<n>();
    Matrix<double, n, 3 * n, Eigen::RowMajor> y;
    const Matrix<double, 1, n> w2 = w.cwiseAbs2().transpose(), ddp = m.ddp.transpose();
    for (int i = 0; i < n; ++i) {
      auto by_p = y.row(i).template head<n>();
      by_p = m.cosines.row(i).cwiseProduct(w2) - m.sines.row(i).cwiseProduct(ddp);
      by_p[i] = 0;
      by_p[i] = -by_p.sum();
      auto by_w = y.row(i).template segment<n>(n);
      by_w = -2 * m.sines.row(i).cwiseProduct(w.transpose());
      by_w[i] -= i + 1 < n ? 2 * damping : damping;
      if (i > 0) by_w[i - 1] += damping;
      if (i + 1 < n) by_w[i + 1] += damping;
      auto by_u = y.row(i).template tail<n>();
      by_u.setZero();
      by_u[i] = 1;
      if (i + 1 < n) by_u[i + 1] = -1;
    }
    m.mass.solve([&](int i) { return y.row(i); });
    a.template bottomRows<n>() = dt * y.template leftCols<nx>();
    for (int i = 0; i < n; ++i) a(n + i, n + i) += 1;
    b.template bottomRows<n>() = dt * y.template rightCols<n>();
  }
};

// A whole problem: J = sum_i w_i (x_N - target_i)^2 / 2 + sum_k dt r |u_k|^2 / 2, and 0 <= u <= 1
// where it is bounded.
template <class Model>
struct Case {
  Model model;
  int steps;
  double r;
  typename Model::X w, target, start;
  bool bounded;
};

// Call `use` with the named problem; return whether there is one.
template <class Use>
bool with_case(const std::string& name, Use&& use) {
  if (name == "P1") {
    use(Case<Pendulum>{{0.01}, 400, 1e-5, {1, 1}, {0, 0}, {3.141592653589793, 0}, false});
  } else if (name == "P2") {
    use(Case<TorqueArm>{{0.005}, 100, 1e-4, {1, 1, 0, 0}, {1, 1.5, 0, 0}, {0.5, 1, 0, 0}, false});
  } else if (name == "P3" || name == "P3f" || name == "P3h") {
    const bool hard = name == "P3h";
    MuscleArm::X w = MuscleArm::X::Zero(), target = w, start = w;
    w.head<4>() << 1, 1, (hard ? 0.01 : 0), (hard ? 0.01 : 0);
    target.head<2>() << (hard ? 1.2 : 1), (hard ? 1.8 : 1.5);
    start << 0.5, 1, 0, 0, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05;
    use(Case<MuscleArm>{
        MuscleArm(hard ? 0.0025 : 0.005), 100, 1e-4, w, target, start, name != "P3f"});
  } else if (name == "P4-4" || name == "P4-8") {
    const auto chain = [&](auto model) {
      using Model = decltype(model);
      constexpr int n = Model::nu;
      typename Model::X w = Model::X::Zero(), target = w, start = w;
      for (int i = 0; i < n; ++i) {
        w[i] = 1;
        start[i] = 0.2 + 0.3 * i;
        target[i] = start[i] + 0.4 / std::sqrt(double(n));
      }
      use(Case<Model>{model, 50, 1e-4, w, target, start, false});
    };
    if (name == "P4-4") chain(Chain<4>(0.01));
    else chain(Chain<8>(0.01));
  } else {
    return false;
  }
  return true;
}

}  // namespace peers
