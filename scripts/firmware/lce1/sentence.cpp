#include "sentence.h"

#include <string.h>

namespace lce1 {

namespace {

const char kHex[] = "0123456789ABCDEF";

int hex_value(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'A' && c <= 'F') return c - 'A' + 10;
  if (c >= 'a' && c <= 'f') return c - 'a' + 10;
  return -1;
}

uint8_t sum_of(const char* data, size_t length) {
  uint8_t sum = 0;
  for (size_t i = 0; i < length; ++i) sum ^= static_cast<uint8_t>(data[i]);
  return sum;
}

}  // namespace

Sentence::Sentence(const char* name) {
  put('$');
  for (; *name; ++name) put(*name);
}

void Sentence::put(char c) {
  // Five characters are kept for the sum and the line end.
  if (length_ + 5 < kMaxLine) {
    data_[length_++] = c;
  } else {
    is_full_ = true;
  }
}

Sentence& Sentence::text(const char* value) {
  put(',');
  for (; *value; ++value) put(*value);
  return *this;
}

Sentence& Sentence::number(uint64_t value, uint8_t min_digits) {
  put(',');
  return digits(value, min_digits);
}

Sentence& Sentence::empty() {
  put(',');
  return *this;
}

Sentence& Sentence::digits(uint64_t value, uint8_t min_digits) {
  // printf of 64-bit numbers is left out of many small C libraries.
  char reversed[20];
  uint8_t n = 0;
  do {
    reversed[n++] = static_cast<char>('0' + value % 10);
    value /= 10;
  } while (value != 0);
  for (uint8_t i = n; i < min_digits; ++i) put('0');
  while (n > 0) put(reversed[--n]);
  return *this;
}

size_t Sentence::finish() {
  if (is_full_) return 0;
  const uint8_t sum = sum_of(data_ + 1, length_ - 1);
  data_[length_++] = '*';
  data_[length_++] = kHex[sum >> 4];
  data_[length_++] = kHex[sum & 15];
  data_[length_++] = '\r';
  data_[length_++] = '\n';
  return length_;
}

Fields::Fields(char* line, size_t length) {
  if (length < 4 || line[0] != '$') return;
  char* star = static_cast<char*>(memchr(line, '*', length));
  if (star == nullptr) return;
  const size_t n_digits = static_cast<size_t>(line + length - star) - 1;
  if (n_digits < 1 || n_digits > 2) return;
  int sum = 0;
  for (size_t i = 1; i <= n_digits; ++i) {
    const int digit = hex_value(star[i]);
    if (digit < 0) return;
    sum = 16 * sum + digit;
  }
  if (sum_of(line + 1, static_cast<size_t>(star - line) - 1) != sum) return;
  *star = '\0';
  char* at = line + 1;
  while (at != nullptr && count_ < kMaxFields) {
    fields_[count_++] = at;
    at = strchr(at, ',');
    if (at != nullptr) *at++ = '\0';
  }
  is_sound_ = at == nullptr;  // no field was left over
}

bool Fields::is_name(const char* name) const { return count_ > 0 && strcmp(fields_[0], name) == 0; }

bool Fields::whole(uint8_t index, uint64_t largest, uint64_t* value) const {
  const char* at = fields_[index];
  uint64_t sum = 0;
  if (*at == '\0') return false;
  for (; *at; ++at) {
    if (*at < '0' || *at > '9') return false;
    sum = 10 * sum + static_cast<uint64_t>(*at - '0');
    if (sum > largest) return false;
  }
  *value = sum;
  return true;
}

bool Fields::micro(uint8_t index, uint64_t largest, uint64_t* value) const {
  const char* at = fields_[index];
  uint64_t sum = 0;
  int n_decimals = -1;
  if (*at < '0' || *at > '9') return false;
  for (; *at; ++at) {
    if (*at == '.' && n_decimals < 0) {
      n_decimals = 0;
      continue;
    }
    if (*at < '0' || *at > '9' || n_decimals == 6) return false;
    sum = 10 * sum + static_cast<uint64_t>(*at - '0');
    if (sum > largest) return false;
    if (n_decimals >= 0) ++n_decimals;
  }
  for (int i = n_decimals < 0 ? 0 : n_decimals; i < 6; ++i) {
    sum *= 10;
    if (sum > largest) return false;
  }
  *value = sum;
  return true;
}

}  // namespace lce1
