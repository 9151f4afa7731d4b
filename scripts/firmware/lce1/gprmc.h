// The sentence that tells a VLP-16 which second has begun.
#pragma once

#include "sentence.h"

namespace lce1 {

// Builds $GPRMC for a UTC second since 1970 (to 2079: the sentence has two digits for the year). The position
// is that of no place in particular; a VLP-16 does not look at it.
Sentence gprmc(uint64_t utc_s);

}  // namespace lce1
