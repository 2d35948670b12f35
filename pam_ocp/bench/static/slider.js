// A coefficient: label, range and number on one line. "slide" while it moves (one message at a time:
// the next is sent when the page has shown the last), "settle" when it is let go.
export default {
  template: `
    <div class="bench-slider">
      <label :for="uid" :title="label">{{ label }}</label>
      <input type="range" :id="uid" :min="0" :max="1000" step="1" :value="place" :aria-valuetext="text"
        @input="slide($event.target.value)" @change="settle" />
      <input type="text" inputmode="decimal" autocomplete="off" :value="text" :aria-label="label + ', ' + unit"
        @change="typed($event.target)" />
      <span class="bench-unit">{{ unit }}</span>
    </div>`,
  props: { label: String, value: Number, low: Number, high: Number, unit: String, seen: Number, heard: Number, log: Boolean },
  data() {
    return { now: this.value, uid: "slider-" + Math.random().toString(36).slice(2), sent: 0, waits: false };
  },
  computed: {
    place() {
      if (!this.log) return Math.round((1000 * (this.now - this.low)) / (this.high - this.low));
      if (this.now <= this.low) return 0; // switched off
      return Math.round((1000 * Math.log(this.now / this.low)) / Math.log(this.high / this.low));
    },
    text() { return String(Number(this.now.toPrecision(6))); },
  },
  watch: {
    value(fresh) { this.now = fresh; },
    heard() { this.now = this.value; },
    seen() { if (this.waits) { this.waits = false; this.send(); } },
  },
  methods: {
    slide(place) {
      const part = place / 1000;
      if (this.log) this.now = Number(place) === 0 ? 0 : Number((this.low * Math.pow(this.high / this.low, part)).toPrecision(4));
      else this.now = this.low + part * (this.high - this.low);
      if (this.sent > (this.seen || 0) && performance.now() - this.at < 500) this.waits = true;
      else this.send();
    },
    send() { this.sent = (this.seen || 0) + 1; this.at = performance.now(); this.$emit("slide", this.now); },
    settle() { this.waits = false; this.$emit("settle", this.now); },
    typed(field) { // with a decimal comma, or the typesetter's minus, too
      const text = field.value.trim().replace(",", ".").replace("\u2212", "-"), number = Number(text);
      if (text !== "" && Number.isFinite(number)) { this.now = number; this.$emit("settle", number); }
      field.value = this.text; // what is no number is taken back
    },
  },
};
