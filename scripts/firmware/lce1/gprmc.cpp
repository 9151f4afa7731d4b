#include "gprmc.h"

namespace lce1 {

namespace {

struct Date {
  uint32_t year, month, day;
};

// Days since 1970 to the Gregorian calendar, years beginning in March, in eras of 400 years.
// Reference: H. Hinnant, "chrono-compatible low-level date algorithms", civil_from_days.
Date date_of(uint64_t days) {
  const uint64_t z = days + 719468;
  const uint64_t era = z / 146097;
  const uint32_t of_era = static_cast<uint32_t>(z - era * 146097);
  const uint32_t year_of_era = (of_era - of_era / 1460 + of_era / 36524 - of_era / 146096) / 365;
  const uint32_t of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
  const uint32_t month_from_march = (5 * of_year + 2) / 153;
  Date date;
  date.day = of_year - (153 * month_from_march + 2) / 5 + 1;
  date.month = month_from_march < 10 ? month_from_march + 3 : month_from_march - 9;
  date.year = static_cast<uint32_t>(year_of_era + era * 400) + (date.month <= 2 ? 1 : 0);
  return date;
}

}  // namespace

Sentence gprmc(uint64_t utc_s) {
  const Date date = date_of(utc_s / 86400);
  const uint32_t second = static_cast<uint32_t>(utc_s % 86400);
  Sentence sentence("GPRMC");
  sentence.number(second / 3600, 2).digits(second / 60 % 60, 2).digits(second % 60, 2);
  sentence.text("A").text("0000.000").text("N").text("00000.000").text("E").text("000.0").text("000.0");
  sentence.number(date.day, 2).digits(date.month, 2).digits(date.year % 100, 2);
  sentence.text("000.0").text("E");
  return sentence;
}

}  // namespace lce1
