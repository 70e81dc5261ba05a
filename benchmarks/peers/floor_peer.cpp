// The floor: a hand-written iLQR with sizes known to the compiler and no allocation in the solve.
//
// Problems without bounds only. Quu is regularised by mu times the mean of its diagonal, mu moving
// by the accelerating schedule of Tassa et al. 2012; line search 1, 1/2, 1/4, ... It stops with the
// step of which a nearly unregularised sweep expects less than TH_STOP times the cost.

#include "command.hpp"
#include "models.hpp"

namespace peers {

// A row of `n` numbers, held in vector registers and padded with room for no more than that.
template <int n>
struct Row {
  static constexpr int width = n <= 4 ? 4 : 8, count = (n + width - 1) / width;
  static constexpr int size = count * width;
  typedef double Pack __attribute__((vector_size(width * sizeof(double))));
  Pack pack[count];

  void set(int i, double value) { reinterpret_cast<double*>(pack)[i] = value; }
  double* data() { return reinterpret_cast<double*>(pack); }
  const double* data() const { return reinterpret_cast<const double*>(pack); }
  // Add a * other, in the first `packs` packs.
  void add(double a, const Row& other, int packs = count) {
#pragma GCC unroll 8
    for (int p = 0; p < packs; ++p) pack[p] += a * other.pack[p];
  }
  void operator*=(double a) {
    for (Pack& p : pack) p *= a;
  }
};

template <class Model>
class Ilqr {
 public:
  static constexpr int nx = Model::nx, nu = Model::nu, nz = nx + nu;
  using X = typename Model::X;
  using U = typename Model::U;
  using R = Row<nz>;

  explicit Ilqr(const Case<Model>& c)
      : case_(c), nodes_(c.steps), xs_(c.steps + 1), us_(c.steps), new_xs_(c.steps + 1),
        new_us_(c.steps) {
    for (Node& node : nodes_) {
      for (R& row : node.f) row = R{};
      c.model.prepare(a(node), b(node));
    }
  }

  const std::vector<U>& us() const { return us_; }

  Outcome solve(const U* start, double th_stop, int maxiter) {
    Outcome result;
    double mu = 0, factor = 1, expected = 0;
    for (int k = 0; k < case_.steps; ++k) us_[k] = start[k];
    result.cost = roll_out<false>(0, us_, xs_);
    bool stale = true;
    while (result.iterations < maxiter) {
      const bool positive = sweep(mu, stale);
      if (positive) stale = false;
      expected = -(linear_ + 0.5 * quadratic_);
      const bool last = positive && mu < 1e-3 && expected <= th_stop * result.cost;
      ++result.iterations;
      bool accepted = false;
      if (positive) {
        double alpha = 1;
        for (int trial = 0; trial < max_trials && !accepted; ++trial, alpha *= 0.5) {
          const double cost = roll_out<true>(alpha, new_us_, new_xs_);
          const double predicted = -alpha * (linear_ + 0.5 * alpha * quadratic_);
          if (result.cost - cost > 1e-4 * predicted) {
            result.cost = cost;
            accepted = true;
          }
        }
      }
      if (accepted) {
        us_.swap(new_us_), xs_.swap(new_xs_);
        stale = true;
      }
      if (last) break;
      if (accepted) {
        factor = std::min(1 / 1.6, factor / 1.6);
        mu = mu * factor >= 1e-6 ? mu * factor : 0;
      } else {
        factor = std::max(1.6, factor * 1.6);
        mu = std::max(1e-6, mu * factor);
        if (mu > 1e10) break;
      }
    }
    result.stop = expected / result.cost;
    return result;
  }

 private:
  static constexpr int max_trials = 11;

  struct Node {
    R f[nx];                      // [A B]
    R gain[nu];                   // K, then k in column nx
    typename Model::Cache cache;  // of the trajectory tried last
  };

  template <int columns, bool one = columns == 1>
  using View = Eigen::Map<Matrix<double, nx, columns, one ? Eigen::ColMajor : Eigen::RowMajor>, 0,
                          Eigen::Stride<one ? nx * R::size : R::size, one ? R::size : 1>>;
  static View<nx> a(Node& node) { return View<nx>(node.f[0].data()); }
  static View<nu> b(Node& node) { return View<nu>(node.f[0].data() + nx); }

  // Follow us_, corrected by the gains where `corrected`; return the cost.
  template <bool corrected>
  double roll_out(double alpha, std::vector<U>& us, std::vector<X>& xs) {
    X x = case_.start;
    double effort = 0;
    for (int k = 0; k < case_.steps; ++k) {
      Node& node = nodes_[k];
      xs[k] = x;
      if constexpr (corrected) {
        const X dx = x - xs_[k];
        U u = us_[k];
        for (int m = 0; m < nu; ++m) {
          const double* gain = node.gain[m].data();
          u[m] += alpha * gain[nx] + Eigen::Map<const X>(gain).dot(dx);
        }
        us[k] = u;
      }
      effort += us[k].squaredNorm();
      x = case_.model.step(x, us[k], node.cache);
    }
    xs[case_.steps] = x;
    const double miss = case_.w.dot((x - case_.target).cwiseAbs2());
    return 0.5 * (miss + case_.model.dt * case_.r * effort);
  }

  // Compute the gains along xs_, us_, linearising there first if `stale`.
  bool sweep(double mu, bool stale) {
    constexpr int packs = R::count;
    const double weight = case_.model.dt * case_.r;
    R v[nx];  // the Hessian of the value; only its lower triangle counts
    double vx[nx];
    for (int i = 0; i < nx; ++i) {
      v[i] = R{};
      v[i].set(i, case_.w[i]);
      vx[i] = case_.w[i] * (xs_[case_.steps][i] - case_.target[i]);
    }
    linear_ = quadratic_ = 0;
    for (int k = case_.steps - 1; k >= 0; --k) {
      Node& node = nodes_[k];
      if (stale) case_.model.linearize(xs_[k], us_[k], node.cache, a(node), b(node));
      R gradient{};
#pragma GCC unroll 16
      for (int j = 0; j < nx; ++j) gradient.add(vx[j], node.f[j]);
      // q = [A B]' V [A B], the rows of u whole and those of x up to the diagonal
      R vf[nx], q[nz];
#pragma GCC unroll 16
      for (int i = 0; i < nx; ++i) {
        vf[i] = R{};
#pragma GCC unroll 16
        for (int j = 0; j < nx; ++j) vf[i].add(j <= i ? v[i].data()[j] : v[j].data()[i], node.f[j]);
      }
#pragma GCC unroll 24
      for (int i = nz - 1; i >= 0; --i) {
        q[i] = R{};
#pragma GCC unroll 16
        for (int j = 0; j < nx; ++j)
          q[i].add(node.f[j].data()[i], vf[j], i < nx ? i / R::width + 1 : packs);
      }
      double trace = 0;
      double qu[nu];
#pragma GCC unroll 8
      for (int m = 0; m < nu; ++m) {
        trace += q[nx + m].data()[nx + m] + weight;
        qu[m] = gradient.data()[nx + m] + weight * us_[k][m];
      }
      const double shift = mu / nu * trace;
      Ldl<nu> quu;
      const auto entry = [&](int i, int j) {
        return q[nx + i].data()[nx + j] + (i == j ? weight + shift : 0);
      };
      if (!quu.factor(entry)) return false;
      // Column nx of the rows of u now makes room for qu.
#pragma GCC unroll 8
      for (int m = 0; m < nu; ++m) {
        q[nx + m].set(nx, qu[m]);
        node.gain[m] = q[nx + m];
        node.gain[m] *= -1;
      }
      quu.solve([&](int m) { return Access{&node.gain[m]}; });
      double squared = 0, slope = 0;
#pragma GCC unroll 8
      for (int m = 0; m < nu; ++m) {
        const double step = node.gain[m].data()[nx];
        slope += step * qu[m], squared += step * step;
      }
      linear_ += slope, quadratic_ -= slope + shift * squared;
      // V = Qxx + K' (Qux - shift K)
      if (shift > 0)
        for (int m = 0; m < nu; ++m) q[nx + m].add(-shift, node.gain[m]);
#pragma GCC unroll 8
      for (int m = 0; m < nu; ++m) gradient.add(node.gain[m].data()[nx], q[nx + m]);
#pragma GCC unroll 16
      for (int i = 0; i < nx; ++i) {
        v[i] = q[i];
#pragma GCC unroll 8
        for (int m = 0; m < nu; ++m) v[i].add(node.gain[m].data()[i], q[nx + m], i / R::width + 1);
        vx[i] = gradient.data()[i];
      }
    }
    return true;
  }

  // What Ldl::solve needs of a row.
  struct Access {
    R* row;
    struct Scaled {
      double a;
      const R* row;
    };
    friend Scaled operator*(double a, const Access& other) { return {a, other.row}; }
    void operator-=(const Scaled& s) { row->add(-s.a, *s.row); }
    void operator*=(double a) { *row *= a; }
  };

  const Case<Model>& case_;
  std::vector<Node> nodes_;
  std::vector<X> xs_;
  std::vector<U> us_;
  std::vector<X> new_xs_;
  std::vector<U> new_us_;
  double linear_ = 0, quadratic_ = 0;  // of the expected change of cost in the step length
};

template <class Model>
void run(const Command& command, const Case<Model>& c) {
  const std::size_t size = std::size_t(c.steps) * Model::nu;
  const std::vector<double> numbers = command.read(size);
  const std::size_t count = numbers.size() / size;
  std::vector<typename Model::U> starts(count * c.steps);
  for (std::size_t i = 0; i < starts.size(); ++i)
    starts[i] = Eigen::Map<const typename Model::U>(numbers.data() + i * Model::nu);
  std::vector<double> solved(numbers.size());
  std::vector<Outcome> outcomes(count);
  Ilqr<Model> solver(c);
  command.run("floor iLQR", solved, outcomes, [&] {
    for (std::size_t i = 0; i < count; ++i) {
      outcomes[i] = solver.solve(&starts[i * c.steps], command.th_stop, command.maxiter);
      double* out = solved.data() + i * size;
      for (const auto& u : solver.us()) out = std::copy_n(u.data(), int(Model::nu), out);
    }
  });
}

}  // namespace peers

int main(int argc, char** argv) {
  const peers::Command command(argc, argv);
  bool bounded = false;
  const bool known = peers::with_case(command.problem, [&](const auto& c) {
    if (c.bounded) bounded = true;
    else peers::run(command, c);
  });
  if (known && !bounded) return 0;
  const char* reason = known ? "has bounds" : "unknown problem";
  std::fprintf(stderr, "%s: %s\n", command.problem.c_str(), reason);
  return 2;
}
