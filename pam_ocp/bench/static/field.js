// A field: label, and a number with its unit, a text, a menu or a tick, on one line. What is typed
// or chosen is the browser's until the page has answered to the last of it: what is drawn anew
// meanwhile, and answers to what was said before, do not take it back.
export default {
  template: `
    <div :class="['bench-field', kind === 'number' ? '' : 'is-wide']">
      <label :for="uid" :title="hint || label">{{ label }}</label>
      <select v-if="kind === 'menu'" :id="uid" v-model="now" @change="say">
        <option v-for="[one, words] in options" :key="one" :value="one">{{ words }}</option>
      </select>
      <input v-else-if="kind === 'tick'" :id="uid" type="checkbox" v-model="now" @change="say" />
      <input v-else :id="uid" type="text" :inputmode="kind === 'number' ? 'decimal' : null" autocomplete="off"
        v-model="now" @change="say" :aria-invalid="kind === 'number' ? String(Boolean(wrong)) : null" :title="wrong || null"
        :style="kind === 'text' ? 'text-align: left' : null" />
      <template v-if="kind === 'number'">
        <select v-if="options.length > 1" :aria-label="'unit of ' + label" :value="unit" @change="$emit('unit', $event.target.value)">
          <option v-for="one in options" :key="one" :value="one">{{ one }}</option>
        </select>
        <span v-else class="bench-unit">{{ unit === "1" ? "" : unit }}</span>
      </template>
    </div>`,
  props: {
    kind: String, label: String, hint: String, value: [String, Boolean], heard: Number, options: Array, unit: String, wrong: String,
  },
  data() { return { now: this.value, sent: 0, uid: "field-" + Math.random().toString(36).slice(2) }; },
  computed: { answer() { return JSON.stringify([this.value, this.heard]); } },
  watch: { answer() { if (this.heard >= this.sent) this.now = this.value; } },
  methods: { say() { this.sent += 1; this.$emit("say", { number: this.sent, value: this.now }); } },
};
