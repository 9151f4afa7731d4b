// The sync board played on a computer: the same core as on the hardware, with standard input and output for
// its USB line, standard error for its line to the LiDAR, and a clock that drifts as told.
//
//   host_board [--drift-ppm P] [--start-us T] [--name N]    runs until its input ends
//   host_board --virtual END_US                             input lines "TIME_US COMMAND"; no time passes
//   host_board --rmc UTC_S...                               prints the sentences of these seconds

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "../lce1/board.h"
#include "../lce1/gprmc.h"

namespace {

constexpr uint64_t kVirtualTickUs = 10;

void write_pin(uint8_t, bool) {}

double elapsed_us() {
  static timespec began = {0, 0};
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  if (began.tv_sec == 0) began = now;
  const double seconds = static_cast<double>(now.tv_sec - began.tv_sec);
  return 1e6 * seconds + 1e-3 * static_cast<double>(now.tv_nsec - began.tv_nsec);
}

int print_sentences(int n, char** seconds) {
  for (int i = 0; i < n; ++i) {
    lce1::Sentence sentence = lce1::gprmc(strtoull(seconds[i], nullptr, 10));
    fwrite(sentence.data(), 1, sentence.finish(), stdout);
  }
  return 0;
}

// Runs through a script of commands tick by tick, as fast as it can, and prints everything the board says.
int run_virtually(uint64_t end_us) {
  lce1::Board board("virtual", write_pin);
  char command[256];
  uint64_t due_us = 0;
  auto read_command = [&]() {
    unsigned long long at_us;
    char line[300];
    if (fgets(line, sizeof line, stdin) == nullptr) return UINT64_MAX;
    return sscanf(line, "%llu %255s", &at_us, command) == 2 ? static_cast<uint64_t>(at_us) : UINT64_MAX;
  };
  due_us = read_command();
  for (uint64_t now_us = kVirtualTickUs; now_us <= end_us; now_us += kVirtualTickUs) {
    board.tick(now_us);
    if (now_us >= due_us) {
      for (const char* c = command; *c; ++c) board.receive(*c, now_us);
      if (board.receive('\n', now_us)) board.apply(now_us);
      due_us = read_command();
    }
    if (const size_t length = board.next_line(now_us)) fwrite(board.line(), 1, length, stdout);
    if (const size_t length = board.next_sentence(now_us)) fwrite(board.sentence(), 1, length, stdout);
  }
  return 0;
}

int run(const char* name, double drift, double start_us) {
  lce1::Board board(name, write_pin);
  auto now_us = [&]() { return static_cast<uint64_t>(start_us + elapsed_us() * (1 + drift)); };
  fcntl(STDIN_FILENO, F_SETFL, fcntl(STDIN_FILENO, F_GETFL) | O_NONBLOCK);
  fcntl(STDOUT_FILENO, F_SETFL, fcntl(STDOUT_FILENO, F_GETFL) | O_NONBLOCK);
  pollfd input = {STDIN_FILENO, POLLIN, 0};
  for (;;) {
    board.tick(now_us());
    char c;
    const ssize_t n = read(STDIN_FILENO, &c, 1);
    if (n == 0 || (n < 0 && errno != EAGAIN)) return 0;
    if (n == 1) {
      if (!board.receive(c, now_us())) continue;
      board.apply(now_us());
    }
    while (const size_t length = board.next_line(now_us())) {
      if (write(STDOUT_FILENO, board.line(), length) != static_cast<ssize_t>(length)) board.drop_line();
    }
    if (const size_t length = board.next_sentence(now_us())) {
      if (write(STDERR_FILENO, board.sentence(), length) < 0) return 1;
    }
    // A tick every 0.2 ms: pulses are late by as much, and their stamps say so.
    const timespec pause = {0, 200000};
    ppoll(&input, 1, &pause, nullptr);
  }
}

}  // namespace

int main(int argc, char** argv) {
  const char* name = "host";
  double drift = 0.0, start_us = 0.0;
  for (int i = 1; i < argc; ++i) {
    if (strcmp(argv[i], "--rmc") == 0) return print_sentences(argc - i - 1, argv + i + 1);
    if (i + 1 >= argc) return 2;
    const char* value = argv[++i];
    if (strcmp(argv[i - 1], "--virtual") == 0) return run_virtually(strtoull(value, nullptr, 10));
    if (strcmp(argv[i - 1], "--drift-ppm") == 0) {
      drift = 1e-6 * atof(value);
    } else if (strcmp(argv[i - 1], "--start-us") == 0) {
      start_us = atof(value);
    } else if (strcmp(argv[i - 1], "--name") == 0) {
      name = value;
    } else {
      return 2;
    }
  }
  return run(name, drift, start_us);
}
