// The command line that all peers share: PROBLEM US_FILE OUT_FILE REPEATS TH_STOP MAXITER.
//
// US_FILE and OUT_FILE hold controls (B, steps, nu) as raw float64. One line of JSON is printed;
// "cpu" and "wall" are the seconds of each repeat, a pass over all B starts, by the processor's
// clock of this process, as jaxctrl takes its own times, and by the wall's.

#pragma once

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <string>
#include <time.h>
#include <vector>

namespace peers {

struct Outcome {
  int iterations = 0;
  double cost = 0, stop = 0;
};

inline double processor_seconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

struct Command {
  std::string problem, us_file, out_file;
  int repeats, maxiter;
  double th_stop;

  Command(int argc, char** argv) {
    if (argc < 7) {
      std::fprintf(stderr, "usage: %s PROBLEM US_FILE OUT_FILE REPEATS TH_STOP MAXITER\n", argv[0]);
      std::exit(2);
    }
    problem = argv[1], us_file = argv[2], out_file = argv[3];
    repeats = std::atoi(argv[4]), th_stop = std::atof(argv[5]), maxiter = std::atoi(argv[6]);
  }

  // Return the controls of all starts, one after another, each of `size` numbers.
  std::vector<double> read(std::size_t size) const {
    std::ifstream file(us_file, std::ios::binary | std::ios::ate);
    const std::size_t bytes = file ? std::size_t(file.tellg()) : 0;
    if (bytes == 0 || bytes % (size * sizeof(double)) != 0) {
      std::fprintf(stderr, "%s: not a whole number of starts\n", us_file.c_str());
      std::exit(2);
    }
    std::vector<double> us(bytes / sizeof(double));
    file.seekg(0);
    file.read(reinterpret_cast<char*>(us.data()), bytes);
    return us;
  }

  // Time `pass`, which solves from every start and fills `outcomes`; write `us` and print.
  template <class Pass>
  void run(const char* solver, const std::vector<double>& us, const std::vector<Outcome>& outcomes,
           Pass&& pass) const {
    std::vector<double> cpu, wall;
    for (int i = 0; i < std::max(1, repeats); ++i) {
      const auto begin = std::chrono::steady_clock::now();
      const double processor = processor_seconds();
      pass();
      cpu.push_back(processor_seconds() - processor);
      const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - begin;
      wall.push_back(taken.count());
    }
    std::ofstream file(out_file, std::ios::binary);
    file.write(reinterpret_cast<const char*>(us.data()), us.size() * sizeof(double));
    std::printf("{\"problem\": \"%s\", \"solver\": \"%s\"", problem.c_str(), solver);
    const auto list = [](const char* name, const auto& values, auto&& print) {
      std::printf(", \"%s\": [", name);
      for (std::size_t i = 0; i < values.size(); ++i) {
        if (i > 0) std::printf(", ");
        print(values[i]);
      }
      std::printf("]");
    };
    // JSON has no infinities: print them, and NaN, as null.
    const auto number = [](double v) {
      if (std::isfinite(v)) std::printf("%.16e", v);
      else std::printf("null");
    };
    list("cpu", cpu, [](double s) { std::printf("%.6e", s); });
    list("wall", wall, [](double s) { std::printf("%.6e", s); });
    list("iterations", outcomes, [](const Outcome& o) { std::printf("%d", o.iterations); });
    list("cost", outcomes, [&](const Outcome& o) { number(o.cost); });
    list("stop", outcomes, [&](const Outcome& o) { number(o.stop); });
    std::printf("}\n");
  }
};

}  // namespace peers
