// A rig's microcontroller (Arduino, ESP32): lines with a check sum, as docs/rig.md has them.
//
// Readings and commands stand in the order of the channels in the rig's file. The board vents by
// itself when no command comes for TIMEOUT_MS, and stays so until it is armed. Wire the valves so
// that they vent without current. 8-bit boards: 115200 baud, and doubles are floats there.

const unsigned long BAUD = 1000000;
const unsigned long TIMEOUT_MS = 40;
const int READ_PINS[] = {A0, A1};       // position, pressure: raw counts; the file calibrates them
const int WRITE_PINS[] = {5};           // PWM or DAC of the regulator, 0 .. 255
const int VENT_VALUES[] = {0};
const int READS = sizeof(READ_PINS) / sizeof(int), WRITES = sizeof(WRITE_PINS) / sizeof(int);

char line[256];
size_t filled = 0;
bool armed = false, known = false;
uint32_t last = 0;
unsigned long heard = 0;

uint32_t crc32(const char *data, size_t size) {
  uint32_t crc = 0xFFFFFFFF;
  for (size_t i = 0; i < size; i++) {
    crc ^= (uint8_t)data[i];
    for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ (0xEDB88320 & (0 - (crc & 1)));
  }
  return ~crc;
}

void vent() {
  armed = false;
  for (int i = 0; i < WRITES; i++) analogWrite(WRITE_PINS[i], VENT_VALUES[i]);
}

uint64_t microseconds() {               // micros() runs over after 71 minutes
  static uint32_t before = 0, over = 0;
  uint32_t now = micros();
  if (now < before) over++;
  before = now;
  return ((uint64_t)over << 32) | now;
}

void answer(const char *sequence) {
  char text[200];
  uint64_t now = microseconds();
  int n = snprintf(text, sizeof text, "<%s %lu%06lu", sequence, (unsigned long)(now / 1000000),
                   (unsigned long)(now % 1000000));
  for (int i = 0; i < READS; i++) n += snprintf(text + n, sizeof text - n, " %d", analogRead(READ_PINS[i]));
  char check[12];
  snprintf(check, sizeof check, "*%08lX\n", (unsigned long)crc32(text, n));
  Serial.print(text);
  Serial.print(check);
}

void act() {                            // one line, without its line feed
  char *star = strrchr(line, '*');
  if (line[0] != '>' || !star || strlen(star) != 9) return;
  if (strtoul(star + 1, NULL, 16) != crc32(line, star - line)) return;
  *star = 0;
  char *sequence = strtok(line + 1, " "), *code = strtok(NULL, " ");
  if (!sequence || !code) return;
  uint32_t number = strtoul(sequence, NULL, 10);
  if (code[0] == 'V') {
    vent();
    answer(sequence);
    return;
  }
  if (known && (int32_t)(number - last) <= 0) return;  // old, or sent twice
  known = true;
  last = number;
  if (code[0] == 'A') {
    armed = true;
    heard = millis();
  } else if (code[0] == 'W') {
    double values[WRITES];
    for (int i = 0; i < WRITES; i++) {
      char *text = strtok(NULL, " ");
      if (!text) return;
      values[i] = atof(text);
      if (isnan(values[i])) return;
    }
    heard = millis();
    for (int i = 0; armed && i < WRITES; i++) analogWrite(WRITE_PINS[i], constrain((int)values[i], 0, 255));
  } else if (code[0] != 'R') return;
  answer(sequence);
}

void setup() {
  Serial.begin(BAUD);
  for (int i = 0; i < WRITES; i++) pinMode(WRITE_PINS[i], OUTPUT);
  vent();
}

void loop() {
  while (Serial.available()) {
    char c = Serial.read();
    if (c == '\n') {
      line[filled] = 0;
      act();
      filled = 0;
    } else if (filled < sizeof line - 1) line[filled++] = c;
  }
  if (armed && millis() - heard > TIMEOUT_MS) vent();
}
